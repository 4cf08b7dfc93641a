"""Settings beside a checkpoint: only plain values come out of them, whatever they ask for."""

import pytest

from formats.errors import FormatError, LimitExceeded
from formats.foreign import beside
from formats.foreign.beside import read_beside
from tests.formats.foreign.samples import BESIDE


def read(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    return read_beside(tmp_path / name)


def test_tags_of_python_are_ignored(tmp_path):
    assert read(tmp_path, "config.yml", BESIDE["nerfacto"]["config.yml"]) == {
        "_target": "nerfstudio.engine.trainer.Trainer",
        "data": ["data", "scene"],
        "again": ["data", "scene"],
        "pipeline": {"model": {"average_init_density": 0.01, "proposal_samples": [96, 64]}},
    }


def test_values_of_yaml(tmp_path):
    text = "a: 1\nb: 1.5\nc: true\nd: null\ne: 2023-01-02\nf: [1, x]\ng: {h: 1e-3}\n<<: {i: 1}\n"
    assert read(tmp_path, "config.yml", text) == {
        **{"a": 1, "b": 1.5, "c": True, "d": None, "e": "2023-01-02", "f": [1, "x"]},
        **{"g": {"h": "1e-3"}, "<<": {"i": 1}},
    }


def test_lines_and_literals(tmp_path):
    lines = (
        BESIDE["nerf-pytorch"]["args.txt"]
        + "# a = b\n\nNerfModel.use_x = False\nsteps = [1, 2.5]\nf = @call()\n"
    )
    expected = {"multires": 10, "datadir": "./data/a=b", "ft_path": None, "white_bkgd": True}
    expected |= {"NerfModel.use_x": False, "steps": [1, 2.5], "f": "@call()"}
    assert read(tmp_path, "args.txt", lines) == expected
    assert read(tmp_path, "config.gin", lines) == expected


def test_lines_of_pairs(tmp_path):
    assert read(tmp_path, "args.txt", BESIDE["pvd"]["args.txt"]) == {
        "PE": 10, "ckpt": "a=b", "stage_iters": {"stage1": -1}, "steps": [1e10],
    }  # fmt: skip


def test_python_is_parsed_and_never_run(tmp_path):
    assert read(tmp_path, "config.py", BESIDE["k-planes"]["config.py"]) == {
        "config": {"density_activation": "trunc_exp", "reso": [1, 2], "a": -1}
    }
    assert read(tmp_path, "config.py", BESIDE["dvgo"]["config.py"]) == {
        "data": {"datadir": "./x", "inverse_y": False}
    }


LAUGHS = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"a{n + 1}: &a{n + 1} [{', '.join([f'*a{n}'] * 10)}]\n" for n in range(12)
)
MERGES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{n + 1}: &a{n + 1}\n  !!merge <<: [*a{n}, *a{n}]\n" for n in range(40)
)
HOSTILE = [
    ("config.yml", LAUGHS),
    ("config.yml", MERGES),
    ("config.yml", "&a [*a]"),
    ("config.yml", "&a {b: *a}"),
    ("config.yml", "!!python/object:x &a {b: *a}"),
    ("config.yml", "[" * 20_000),
    ("config.yml", "{a: " * 20_000),
    ("config.yml", "- " * 30_000),
    ("config.yml", "? " * 10_000),
    ("config.yml", "a: b: c"),
    ("config.yml", "? [a]\n: 1"),
    ("config.yml", "? {a: 1}\n: 1"),
    ("config.yml", "*unknown"),
    ("config.yml", "a: \x00"),
    ("config.yml", "a: " + "9" * 5000),
    ("config.yml", "a: 0x" + "f" * 5000),
    ("config.yml", "%YAML 9.9\n---\na"),
    ("options.json", "[" * 20_000),
    ("options.json", "{"),
    ("options.json", "[1]"),
    ("config.yml", "- 1"),
    ("config.yml", ""),
    ("config.py", "a = " + "[" * 3000),
    ("config.py", "a = " + "-" * 60_000 + "1"),
    ("config.py", "a = " + "not " * 20_000 + "1"),
    ("config.py", "a = " + "0x" + "f" * 5000),
    ("config.py", "a = " + "9" * 5000),
    ("config.py", "a ="),
    ("config.py", "a = '\x00'"),
]


@pytest.mark.parametrize("name, text", HOSTILE)
def test_hostile_settings_are_refused(name, text, tmp_path):
    with pytest.raises(FormatError) as caught:
        read(tmp_path, name, text)
    assert str(caught.value).isprintable() and name in str(caught.value)


def test_large_settings_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(beside, "MAX_NODES", 100)
    for name, text in (("config.yml", "- 1\n" * 200), ("args.txt", "a = 1\n" * 30_000)):
        with pytest.raises(LimitExceeded):
            read(tmp_path, name, text)


def test_odd_lines_are_text(tmp_path):
    odd = {
        "a": "(" * 300,
        "b": "[[1]",
        "c": "os.system('x')",
        "d": "{[1]: 2}",
        "e": "lambda: 0",
        "f": "'\\d'",
    }
    settings = read(tmp_path, "args.txt", "".join(f"{key} = {value}\n" for key, value in odd.items()))
    assert settings == odd | {"f": "\\d"}
