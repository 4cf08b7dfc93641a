"""The scene graph keeps the laws of transforms, survives its JSON as spelled, and refuses what is hostile."""

import json
import os
import re
import time
import unicodedata
import warnings
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats import errors
from formats.scene import (
    MAX_DEPTH,
    MAX_NODES,
    SceneGraph,
    SceneSchema,
    dump_scene,
    is_scene,
    make_node,
    parse_scene,
    read_scene,
    write_scene,
)
from formats.sources import expand_scene, resolve_source

MEMBER = "fields/0123456789abcdef.safetensors"
number = st.floats(-100, 100, allow_nan=False)
size = st.floats(0.5, 2)
unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
unit = unit.map(lambda q: (np.array(q) / np.linalg.norm(q)).tolist())
placements = st.one_of(
    st.just({}),
    st.fixed_dictionaries(
        {},
        optional={
            "translation": st.tuples(number, number, number),
            "rotation": unit,
            "scale": st.tuples(size, size, size),
        },
    ),
    st.tuples(number, number, number).map(
        lambda t: {"matrix": [[2, 1, 0, t[0]], [0, 3, 0, t[1]], [0, 0, -1, t[2]], [0, 0, 0, 1]]}
    ),
)


def scene_json(*nodes, **keys) -> bytes:
    return json.dumps({"format": "rfpack", "version": "1.0", "nodes": nodes, **keys}).encode()


def placed(**placement) -> np.ndarray:
    return make_node("n", **placement).node_to_parent


@st.composite
def scenes(draw):
    names = iter(
        draw(
            st.lists(
                st.text("aé日-", min_size=1),
                min_size=6,
                max_size=6,
                unique_by=lambda s: unicodedata.normalize("NFC", s),
            )
        )
    )

    def node(children=()):
        kind = draw(st.sampled_from([{}, {"field": MEMBER}, {"source": "a/b.rfpack"}]))
        return make_node(
            next(names), **kind, **draw(placements), background=draw(st.booleans()), children=children
        )

    return SceneGraph(
        (node((node((node(),)), node())), node()), draw(st.sampled_from(["max", "add"])), ({"op": "fuse"},)
    )


@settings(max_examples=40, deadline=None)
@given(scenes())
def test_round_trip(scene):
    data = dump_scene(scene)
    assert parse_scene(data, "here") == scene
    assert dump_scene(parse_scene(data, "here")) == data


@settings(max_examples=40, deadline=None)
@given(scenes())
def test_a_leaf_is_placed_by_the_product_from_the_root_down(scene):
    def naive(nodes, parent):
        for node in nodes:
            if node.field or node.source:
                yield node.name, parent @ node.node_to_parent
            yield from naive(node.children, parent @ node.node_to_parent)

    expected = list(naive(scene.nodes, np.eye(4)))
    assert [leaf.name for leaf in scene.leaves()] == [name for name, _ in expected]
    for leaf, (_, object_to_world) in zip(scene.leaves(), expected, strict=True):
        np.testing.assert_allclose(leaf.object_to_world, object_to_world, rtol=1e-12)


def test_placement_by_hand():
    half = np.sqrt(0.5)
    matrix = placed(translation=[1, 2, 3], rotation=[0, 0, half, half], scale=[2, 3, 4])
    np.testing.assert_allclose(matrix, [[0, -3, 0, 1], [2, 0, 0, 2], [0, 0, 4, 3], [0, 0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(placed(), np.eye(4))


@given(unit)
def test_rotations_are_rotations(quaternion):
    rotation = placed(rotation=quaternion)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_a_quaternion_of_two_decimals_is_normalised_and_kept_as_spelled():
    node = make_node("n", rotation=[0, 0, 0.38, 0.92])
    np.testing.assert_allclose(np.linalg.norm(node.node_to_parent[:3, :3], axis=0), 1)
    assert node.placement == {"rotation": [0, 0, 0.38, 0.92]}


def test_json_is_for_people():
    text = dump_scene(SceneGraph((make_node("é", source="a.rfpack", translation=(1, 0, 2)),))).decode()
    assert '"name": "é"' in text and '"translation": [1, 0, 2]' in text and text.endswith("}\n")


def test_unknown_keys_of_the_scene_survive():
    """P1."""
    scene = parse_scene(scene_json(author="me", a={"b": [1]}), "here")
    assert parse_scene(dump_scene(scene), "here").extras == {"author": "me", "a": {"b": [1]}}


def test_a_newer_minor_version_warns_and_keeps_what_it_does_not_know():
    """P1."""
    data = scene_json({"name": "a", "glow": 1, "children": [{"name": "b", "glow": 2}]}, version="1.7")
    with pytest.warns(errors.FormatWarning, match="1.7"):
        scene = parse_scene(data, "here")
    written = json.loads(dump_scene(scene))
    assert (written["version"], written["nodes"][0]["glow"]) == ("1.7", 1)
    assert written["nodes"][0]["children"][0]["glow"] == 2


def test_what_pictures_show_is_kept_and_asks_for_version_1_1():
    """P1: a scene without it keeps its bytes, and a later version its number."""
    box = (-1.0, -2.0, -3.0, 1.0, 2.0, 3.5)
    plain = SceneGraph((make_node("a", source="a.rfpack"),))
    framed = parse_scene(dump_scene(replace(plain, framing=box)), "here")
    assert (plain.version, framed.version, framed.framing) == ("1.0", "1.1", box)
    assert b'"version": "1.0"' in dump_scene(plain) and b"framing" not in dump_scene(plain)
    assert dump_scene(framed) == dump_scene(replace(plain, framing=box))
    later = json.loads(dump_scene(replace(plain, framing=box, version="1.10")))
    assert (later["version"], later["framing"]) == ("1.10", list(box))


def node(**keys) -> bytes:
    return scene_json({"name": "n", **keys})


def nested(depth) -> bytes:
    root = {"name": "0"}
    for i in range(1, depth):
        root = {"name": str(i), "children": [root]}
    return scene_json(root)


REFUSED = {
    "syntax": (b"{", errors.BadJson),
    "empty": (b"", errors.BadJson),
    "utf-16": ("{}".encode("utf-16"), errors.BadJson),
    "duplicate key": (b'{"format": "rfpack", "format": "rfpack"}', errors.BadJson),
    "nan": (scene_json(history=[{"x": float("nan")}]), errors.BadJson),
    "infinity": (b'{"x": -Infinity}', errors.BadJson),
    "1e999": (b'{"x": 1e999}', errors.BadJson),
    "5000 digits": (b'{"x": ' + b"9" * 5000 + b"}", errors.BadJson),
    "2^63": (b'{"x": %d}' % 2**63, errors.BadJson),
    "half a surrogate pair": (rb'{"x": [["\ud800"]]}', errors.BadJson),
    "nested lists": (b"[" * 100_000, errors.BadJson),
    "too large": (b" " * (4 << 20) + b"{}", errors.LimitExceeded),
    "no object": (b"[]", errors.BadSchema),
    "no format": (b'{"frames": []}', errors.BadSchema),
    "version number": (scene_json(version=1.0), errors.BadSchema),
    "version words": (scene_json(version="1.0.0"), errors.BadSchema),
    "newer major": (scene_json(version="2.0"), errors.NewerVersion),
    "requires": (scene_json(requires=["time"]), errors.NewerVersion),
    "framing of 5": (scene_json(framing=[0, 0, 0, 1, 1]), errors.BadSchema),
    "framing inside out": (scene_json(framing=[0, 0, 1, 1, 1, 0]), errors.BadSchema),
    "framing far": (scene_json(framing=[0, 0, 0, 1, 1, 1e300]), errors.BadSchema),
    "framing of text": (scene_json(framing=["0", 0, 0, 1, 1, 1]), errors.BadSchema),
    "null framing": (scene_json(framing=None), errors.BadSchema),
    "null cameras": (scene_json(cameras=None), errors.BadSchema),
    "no nodes": (b'{"format": "rfpack", "version": "1.0"}', errors.BadSchema),
    "nodes object": (b'{"format": "rfpack", "version": "1.0", "nodes": {}}', errors.BadSchema),
    "node number": (scene_json(1), errors.BadSchema),
    "composition": (scene_json(composition="min"), errors.BadSchema),
    "history": (scene_json(history=[1]), errors.BadSchema),
    "unknown node key": (node(sorce="a"), errors.BadSchema),
    "nameless": (scene_json({"source": "a"}), errors.BadSchema),
    "empty name": (node(name=""), errors.BadSchema),
    "long name": (node(name="é" * 200), errors.BadName),
    "name clears the screen": (node(name="a\x1b[2J"), errors.BadName),
    "name runs backwards": (node(name="a\u202eb"), errors.BadName),
    "field and source": (node(field=MEMBER, source="a"), errors.BadSchema),
    "field path": (node(field="../x"), errors.BadSchema),
    "null source": (node(source=None), errors.BadSchema),
    "background number": (node(background=1), errors.BadSchema),
    "two numbers": (node(translation=[1, 2]), errors.BadSchema),
    "boolean number": (node(scale=[1, 1, True]), errors.BadSchema),
    "text number": (node(scale=["1", 1, 1]), errors.BadSchema),
    "matrix and scale": (node(matrix=np.eye(4).tolist(), scale=[1, 1, 1]), errors.BadSchema),
    "projective matrix": (node(matrix=[*np.eye(4).tolist()[:3], [0, 0, 1, 1]]), errors.BadSchema),
    "matrix by columns": (node(matrix=(np.eye(4) + np.eye(4, k=-3)).tolist()), errors.BadSchema),
    "quaternion length": (node(rotation=[0, 0, 0.5, 0.5]), errors.BadSchema),
    "quaternion zero": (node(rotation=[0, 0, 0, 0]), errors.BadSchema),
    "flat": (node(scale=[1, 1, 0]), errors.SingularTransform),
    "tiny": (node(scale=[1e-13] * 3), errors.SingularTransform),
    "huge": (node(scale=[1e300] * 3), errors.SingularTransform),
    "condition": (node(scale=[1e-3, 1, 2e3]), errors.SingularTransform),
    "far": (node(translation=[1e300, 0, 0]), errors.LimitExceeded),
    "product": (
        node(scale=[1e-7] * 3, children=[{"name": "c", "scale": [1e-7] * 3}]),
        errors.SingularTransform,
    ),
    "same name": (node(children=[{"name": "n"}]), errors.DuplicateName),
    "same name, composed otherwise": (
        scene_json({"name": "\u00e9"}, {"name": "e\u0301"}),
        errors.DuplicateName,
    ),
    "deep": (nested(MAX_DEPTH + 1), errors.LimitExceeded),
    "many": (scene_json(*[{"name": str(i)} for i in range(MAX_NODES + 1)]), errors.LimitExceeded),
}


@pytest.mark.parametrize(("data", "error"), REFUSED.values(), ids=REFUSED)
def test_refused(data, error):
    """P12, P13, P15."""
    with pytest.raises(error, match="^here: ") as caught:
        parse_scene(data, "here")
    assert type(caught.value) is error and str(caught.value).isprintable()


def test_the_group_of_the_page_is_one():
    """docs/how-fusing-works.md shows how a scene with a group is written."""
    page = (Path(__file__).parents[2] / "docs/how-fusing-works.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    scene = parse_scene(block.encode(), "the page")
    assert [leaf.groups for leaf in scene.leaves()] == [(), *[(("fountain", "add"),)] * 2]
    again = parse_scene(dump_scene(scene), "again")  # by the version and features that the page names
    assert (again.nodes, again.version) == (scene.nodes, scene.version)
    assert json.loads(dump_scene(scene))["requires"] == json.loads(block)["requires"]


@pytest.mark.parametrize(
    "content, says",
    [
        (
            node(nodes=[]),
            "node 'n' has the word 'nodes', expected some of name, field, source, .*, children$",
        ),
        (node(children=[{"name": "c", "sorce": "a"}]), "node 'c' has the word 'sorce', expected some of"),
        (node(scale=[1, 1, 0]), r"node 'n': scale \[1.0, 1.0, 0.0\] is not three numbers, none of them 0$"),
        (node(name="é" * 200), "node name 'é+…' has 400 bytes; give one of at most 255$"),
    ],
)
def test_a_sentence_says_what_was_expected(content, says):
    with pytest.raises(errors.FormatError, match=f"^here: {says}"):
        parse_scene(content, "here")


def test_limits_themselves_are_accepted_at_once():
    began = time.process_time()
    assert len(parse_scene(nested(MAX_DEPTH), "here").nodes) == 1
    assert (
        len(parse_scene(scene_json(*[{"name": str(i)} for i in range(MAX_NODES)]), "here").nodes) == MAX_NODES
    )
    assert time.process_time() - began < 5
    for scale in (1e-12, 1e12):
        placed(scale=[scale] * 3)
    placed(translation=[1e13, 0, 0])


NEAR = [{"scale": [1e-4] * 3}, {"scale": [1e4] * 3}, {"translation": [0, -1e6, 0]}]
FAR = [{"scale": [0.99e-4] * 3}, {"scale": [1.01e4] * 3}, {"translation": [0, -1.01e6, 0]}]


@pytest.mark.parametrize("words", NEAR)
def test_a_scene_that_any_reader_takes_requires_nothing(words):
    content = json.loads(dump_scene(SceneGraph((make_node("n", **words),))))
    assert content["version"] == "1.0" and "requires" not in content


@pytest.mark.parametrize("words", FAR)
def test_a_far_scene_requires_a_reader_that_knows_of_such(words):
    """Those before version 1.3 refuse whatever `requires` names; what is near again requires it no more."""
    data = dump_scene(SceneGraph((make_node("n", **words),)))
    content = json.loads(data)
    assert content["version"] == "1.3" and content["requires"] == ["far"]
    scene = parse_scene(data, "here")
    assert dump_scene(scene) == data and not scene.extras
    assert "requires" not in json.loads(dump_scene(replace(scene, nodes=(make_node("n"),))))


def test_far_groups_and_framings_require_it_too():
    half = {"scale": [1e-3] * 3, "children": (make_node("c", scale=[1e-3] * 3),)}
    for scene in (
        SceneGraph((make_node("n", **half),)),
        SceneGraph((), framing=(1e12, 0.0, 0.0, 2e12, 1.0, 1.0)),
    ):
        assert json.loads(dump_scene(scene))["requires"] == ["far"]


@pytest.mark.parametrize("required", [["far", "time"], ["time"], "far", {"far": 1}, 1, [["far"]]])
def test_what_else_is_required_is_refused(required):
    with pytest.raises(errors.NewerVersion, match="here: requires"):
        parse_scene(scene_json(requires=required), "here")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_transforms_made_in_memory_must_be_finite(value):
    with pytest.raises(errors.NotFinite, match="'n'.*translation"):
        placed(translation=[0, value, 0])


def test_a_stretch_warns():
    with pytest.warns(errors.FormatWarning, match="stretched 5000 times"):
        placed(scale=[0.01, 50, 1])


def test_emoji_with_joiners_are_names():
    assert make_node("👩‍🚀 chair").name == "👩‍🚀 chair"


def test_what_could_not_be_read_is_not_written():
    with pytest.raises(errors.BadSchema):
        dump_scene(SceneGraph((), history=("text",)))
    with pytest.raises(errors.BadJson):
        dump_scene(SceneGraph((), history=({"psnr": float("inf")},)))


def test_schema_is_the_committed_one():
    committed = Path(__file__).parents[2] / "formats" / "scene.schema.json"
    assert json.loads(committed.read_text()) == {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "rfpack scene graph",
        **msgspec.json.schema(SceneSchema),
    }


def test_files(tmp_path):
    path, scene = tmp_path / "any.name", SceneGraph((make_node("a", source="a.rfpack"),))
    write_scene(path, scene)
    assert read_scene(path) == scene and is_scene(path)
    with pytest.raises(errors.OutputExists):
        write_scene(path, scene)
    path.write_bytes(node(field=MEMBER))
    with pytest.raises(errors.BadSchema, match="'n' names a field"):
        read_scene(path)
    path.write_bytes(b'{"frames": []}')
    assert not is_scene(path) and not is_scene(tmp_path) and not is_scene(tmp_path / "absent")


def test_inputs_that_are_no_files(tmp_path):
    """P9."""
    with pytest.raises(errors.MissingFile):
        read_scene(tmp_path / "absent")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(errors.NotAFile):
            read_scene(path)
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(errors.LimitExceeded):
        read_scene(tmp_path / "sparse")


@pytest.fixture
def folder(tmp_path):
    """scene/ with a file and links out of it, beside scene-evil/ whose name begins alike."""
    for name in ("scene", "scene-evil"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.rfpack").touch()
    (tmp_path / "scene" / "link").symlink_to(tmp_path / "scene-evil")
    (tmp_path / "scene" / "link.rfpack").symlink_to(tmp_path / "scene-evil" / "a.rfpack")
    (tmp_path / "scene" / "inner.rfpack").symlink_to("a.rfpack")
    return tmp_path / "scene"


OUTSIDE = [
    "../scene-evil/a.rfpack",
    "x/../../scene-evil/a.rfpack",
    "/etc/passwd",
    "..\\a",
    "C:\\a",
    "C:a",
    "file:///a",
]
OUTSIDE += ["link/a.rfpack", "link.rfpack", "\uff0e\uff0e/scene-evil/a.rfpack", "..", "\\\\host\\a"]


@pytest.mark.parametrize("source", OUTSIDE)
def test_sources_outside_are_refused(folder, source):
    """P9."""
    with pytest.raises(errors.OutsideFolder, match="--allow-outside"):
        resolve_source(folder / "scene.json", source)


@pytest.mark.parametrize("source", ["../scene-evil/a.rfpack", "link/a.rfpack", "link.rfpack"])
def test_sources_outside_on_request(folder, source):
    assert resolve_source(folder / "scene.json", source, allow_outside=True).samefile(folder / "link.rfpack")


@pytest.mark.parametrize("source", ["a.rfpack", "./a.rfpack", "inner.rfpack"])
def test_sources_inside(folder, source):
    assert resolve_source(folder / "scene.json", source).samefile(folder / "a.rfpack")


def test_sources_that_are_not_there(folder):
    for source in ("absent", "a" * 3000):
        with pytest.raises(errors.MissingFile, match="node 'n': source 'a"):
            resolve_source(folder / "scene.json", source, node="n")
    with pytest.raises(errors.MissingFile, match=f"; put it at {folder}/absent, or name another source"):
        resolve_source(folder / "scene.json", "absent")
    for source in ("", "a\0b", "a\nb"):
        with pytest.raises(errors.BadName):
            resolve_source(folder / "scene.json", source)


def test_nested_scenes_become_groups(tmp_path):
    (tmp_path / "room").mkdir()
    for path in ("a.rfpack", "room/b.rfpack"):
        (tmp_path / path).touch()
    chair = make_node("b", source="b.rfpack", translation=[1, 0, 0])
    write_scene(tmp_path / "room" / "room.json", SceneGraph((chair,)))
    rooms = [
        make_node(n, source="room/room.json", scale=[s] * 3, background=s == 2)
        for n, s in (("x", 2), ("y", 3))
    ]
    write_scene(tmp_path / "s.json", SceneGraph((make_node("a", source="a.rfpack"), *rooms)))
    leaves = expand_scene(tmp_path / "s.json").leaves()
    assert [(leaf.name, leaf.source) for leaf in leaves] == [
        ("a", "a.rfpack"),
        ("x/b", "room/b.rfpack"),
        ("y/b", "room/b.rfpack"),
    ]
    assert [leaf.object_to_world[0, 3] for leaf in leaves] == [0, 2, 3]
    assert [leaf.background for leaf in leaves] == [False, True, False]


def test_a_scene_that_leads_back_to_itself(tmp_path):
    """P13."""
    for here, there in (("a", "b"), ("b", "a")):
        write_scene(tmp_path / f"{here}.json", SceneGraph((make_node("n", source=f"{there}.json"),)))
    with pytest.raises(errors.CyclicScene, match="a.json -> b.json -> a.json"):
        expand_scene(tmp_path / "a.json")


def test_scenes_that_double_at_every_level_are_stopped(tmp_path):
    """P13."""
    (tmp_path / "40.json").touch()
    for i in range(40):
        twice = tuple(make_node(n, source=f"{i + 1}.json") for n in "ab")
        write_scene(tmp_path / f"{i}.json", SceneGraph(twice))
    with pytest.raises(errors.LimitExceeded, match="unfold"):
        expand_scene(tmp_path / "0.json")


def test_a_nested_scene_keeps_the_rule_of_composition(tmp_path):
    (tmp_path / "a").touch()
    pair = tuple(make_node(name, source="a") for name in "bc")
    write_scene(tmp_path / "inner.json", SceneGraph(pair, "add"))
    write_scene(tmp_path / "outer.json", SceneGraph((make_node("n", source="inner.json"), *pair)))
    scene = expand_scene(tmp_path / "outer.json")
    assert [(leaf.name, leaf.groups) for leaf in scene.leaves()] == [
        ("n/b", (("n", "add"),)), ("n/c", (("n", "add"),)), ("b", ()), ("c", ())
    ]  # fmt: skip
    again = parse_scene(dump_scene(scene), "here")
    assert again.nodes == scene.nodes and again.version == "1.4"
    assert json.loads(dump_scene(scene))["requires"] == ["rules"]
    beside = make_node("n", source="inner.json", children=pair)
    write_scene(tmp_path / "mixed.json", SceneGraph((beside,)))
    with pytest.raises(errors.BadSchema, match="'add'.*'max'"):
        expand_scene(tmp_path / "mixed.json")
    with pytest.raises(errors.BadSchema, match="neither"):
        replace(scene.nodes[0], composition="min")


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_change_of_a_value_is_read_or_refused(data):
    """P18: Whatever JSON stands in one place of a valid scene, the outcome is a scene or a FormatError."""
    junk = st.recursive(
        st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
        lambda inner: st.one_of(st.lists(inner, max_size=5), st.dictionaries(st.text(), inner, max_size=3)),
    )
    content = json.loads(node(translation=[1, 2, 3], rotation=[0, 0, 0, 1], children=[{"name": "c"}]))
    at = data.draw(st.sampled_from([content, content["nodes"][0], content["nodes"][0]["children"][0]]))
    keys = [*at, "matrix", "history", "requires", "framing", "cameras"]
    at[data.draw(st.sampled_from(keys))] = data.draw(junk)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.FormatWarning)
        try:
            scene = parse_scene(json.dumps(content).encode(), "here")
        except errors.FormatError as error:
            assert str(error).isprintable()
        else:
            assert parse_scene(dump_scene(scene), "here") == scene
