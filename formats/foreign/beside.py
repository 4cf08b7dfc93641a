"""Settings that a run leaves beside its checkpoint: YAML, JSON, lines "key = value" or "('key', value)", and
Python literals.

None of them runs anything: YAML's Python tags are ignored, Python is parsed and only literals are taken.
"""

import ast
import warnings
from pathlib import Path

import yaml

from formats.errors import BadCheckpoint, FormatError, LimitExceeded
from formats.foreign.stored import check_plain
from formats.safe_input import decoded, parse_json, read_input

MAX_BYTES = 128 << 10
MAX_NODES = 20_000
MAX_DEPTH = 40
AGAIN = "write it again"


def read_beside(path: Path) -> dict:
    """What a file of settings says, by the ending of its name. Raises FormatError."""
    data = read_input(path, MAX_BYTES)
    try:
        if path.suffix == ".json":
            value = parse_json(data, "it")
        else:
            value = READERS[path.suffix](decoded(data))
    except FormatError as error:
        raise error.within(str(path)) from error
    except (ValueError, TypeError, yaml.YAMLError, SyntaxError, RecursionError, MemoryError) as error:
        shown = " ".join(str(error).split())[:200]
        raise BadCheckpoint(f"{path}: cannot be read as settings ({shown}); {AGAIN}") from error
    if not isinstance(value, dict):
        raise BadCheckpoint(
            f"{path}: holds a {type(value).__name__}, expected settings by their names; {AGAIN}"
        )
    check_plain(value, str(path))
    return value


# --- YAML ---------------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """Plain values only: a Python object is its mapping, list or text, and a Python name is its text."""

    yaml_implicit_resolvers = {
        first: [
            (tag, pattern)
            for tag, pattern in resolvers
            if tag.rpartition(":")[2] not in ("merge", "timestamp")
        ]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    yaml_constructors = {
        f"tag:yaml.org,2002:{kind}": yaml.SafeLoader.yaml_constructors[f"tag:yaml.org,2002:{kind}"]
        for kind in ("null", "bool", "int", "float", "str", "seq", "map")
    }

    nodes = depth = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge keys stay keys: what they merge could double with each."""

    def compose_node(self, parent: yaml.Node, index: int) -> yaml.Node:
        self.nodes, self.depth = self.nodes + 1, self.depth + 1
        if self.nodes > MAX_NODES or self.depth > MAX_DEPTH:
            raise LimitExceeded(f"its YAML has more than {MAX_NODES:,} nodes or {MAX_DEPTH} levels")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def plain(self, tag: str, node: yaml.Node) -> object:
        """A node of any other tag."""
        if isinstance(node, yaml.MappingNode):
            return self.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return self.construct_sequence(node, deep=True)
        return tag.removeprefix("name:") if tag.startswith("name:") else self.construct_scalar(node)


_Loader.yaml_multi_constructors = {"tag:yaml.org,2002:python/": _Loader.plain, "": _Loader.plain}


def _yaml(text: str) -> object:
    return yaml.load(text, _Loader)


# --- "key = value" and Python -------------------------------------------------------------------------------


def _lines(text: str) -> dict[str, object]:
    """Lines "key = value", as argparse and gin settings are written; a value that is no literal is text. Or
    lines "('key', value)" of literals, as PVD's are."""
    settings = {}
    for line in text.splitlines():
        if line.startswith("(") and isinstance(pair := _value(line), list):
            if len(pair) == 2 and isinstance(pair[0], str):
                settings[pair[0]] = pair[1]
            continue
        key, equals, value = line.partition("=")
        if equals and not line.startswith(("#", " ")):
            settings[key.strip()] = _value(value.strip())
    return settings


def _value(text: str) -> object:
    try:
        return _literal(_parsed(text, "eval").body)
    except (ValueError, TypeError, SyntaxError):
        return text


def _python(text: str) -> dict[str, object]:
    """The literals that the statements `name = literal` of a file of Python assign; others are left out."""
    settings = {}
    for statement in _parsed(text, "exec").body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            try:
                settings[statement.targets[0].id] = _literal(statement.value)
            except (ValueError, TypeError):
                continue
    return settings


def _parsed(text: str, mode: str) -> ast.AST:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of unusual escapes, which would be printed
        return ast.parse(text, mode=mode)


def _literal(node: ast.expr) -> object:
    """The value of a literal, with dict(key=literal) as one. Raises ValueError."""
    match node:
        case ast.Constant(value=None | bool() | int() | float() | str()):
            return node.value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float())):
            return -node.operand.value
        case ast.List() | ast.Tuple():
            return [_literal(item) for item in node.elts]
        case ast.Dict():
            return {_literal(key): _literal(value) for key, value in zip(node.keys, node.values, strict=True)}
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords):
            return {word.arg: _literal(word.value) for word in keywords if word.arg}
    raise ValueError("not a literal")


READERS = {".yml": _yaml, ".txt": _lines, ".gin": _lines, ".py": _python}
