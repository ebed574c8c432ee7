"""Reads YAML into dataclasses, and says in one sentence what is wrong with it.

Drake's `yaml_load_typed` does the reading.  It tells a programmer what is wrong; this
module tells a user, and where: it names the file and the key.
"""

from collections.abc import Callable, Iterable, Iterator
import dataclasses
import difflib
from pathlib import Path
import re
import types
import typing
from typing import Any, Final, TypeVar

from pydrake.common.yaml import (
    yaml_dump,
    yaml_dump_typed,
    yaml_load,
    yaml_load_typed,
)
import yaml  # type: ignore[import-untyped]

from rhp_drake.errors import InputError

_T = TypeVar("_T")
_TAG: Final = "_tag"  # Where Drake keeps a mapping's YAML tag, e.g. "!GreedyConfig".
_KINDS: Final = {
    "int": "an integer",
    "float": "a number",
    "str": "a text",
    "bool": "true or false",
}


def read_document(text: str, where: str) -> dict[str, Any]:
    """Parses `text`, a YAML document whose root is a mapping.

    Args:
        text: The document.
        where: What to call it in errors, e.g. its file name.

    Raises:
        InputError: If it is no YAML, or its root is no mapping.
    """
    try:
        document = yaml_load(data=text) if text.strip() else {}
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        if problem.startswith("expected a mapping node"):
            problem += "; a tag without keys needs braces, '!Tag {}'"
        raise InputError(f"{where}{line}: not valid YAML: {problem}.") from None
    if not isinstance(document, dict) or not document:
        raise InputError(f"{where}: expected a mapping of names to values.")
    return document


def read_file(path: Path) -> dict[str, Any]:
    """As `read_document`, for a file.

    Raises:
        InputError: As there, or if the file cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not valid YAML: not a text file.") from None
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{path}: cannot be read: {reason}.") from None
    return read_document(text, str(path))


def merge(node: dict[str, Any], defaults: _T, where: str) -> _T:
    """A copy of `defaults`, a dataclass, with the values of `node` in it.

    Where several kinds are possible, a mapping without a tag is of the default's kind,
    and keeps the rest of it.

    Args:
        node: A part of what `read_document` returned.
        defaults: What the keys that `node` does not have keep.
        where: What to call the node in errors.

    Raises:
        InputError: If a key is unknown or a value is of the wrong kind.
    """
    for key, value in node.items():
        # Drake would hand such a value to the constructor as its first argument.
        default = getattr(defaults, key, None)
        if dataclasses.is_dataclass(default) and not isinstance(value, dict):
            raise InputError(
                f"{where}: {key}: expected a mapping, '!Tag {{key: value}}' or "
                f"'{{key: value}}', not {value!r}."
            )
    node = _with_tags(node, defaults)
    error = _attempt(node, defaults)
    if error is not None:
        blamed = _blame(node, lambda part: _attempt(part, defaults))
        key, value, tag, error = blamed or ("its keys", node, None, error)
        problem = _explain(error, key, value, tag, defaults)
        raise InputError(f"{where}: {key}: {problem}.")
    return yaml_load_typed(data=yaml_dump(node), defaults=defaults)


def expand(value: Any) -> dict[str, Any]:
    """A dataclass and all its defaults as mappings, lists and scalars, for JSON.

    `merge` reads the result back: tags are kept under the key "_tag".
    """
    return yaml_load(data=yaml_dump_typed(value))


def _with_tags(node: dict[str, Any], defaults: Any) -> dict[str, Any]:
    """A copy of `node`; mappings that need a tag and have none have their default's.

    Without it Drake would take a union's first type, and lose the default.
    """
    node = dict(node)
    for field in dataclasses.fields(defaults):
        value, default = node.get(field.name), getattr(defaults, field.name)
        if not isinstance(value, dict) or not dataclasses.is_dataclass(default):
            continue
        tag = f"!{type(default).__name__}"
        if value.get(_TAG, tag) == tag:
            value = _with_tags(value, default)
            node[field.name] = ({_TAG: tag} if _is_union(field.type) else {}) | value
    return node


def _is_union(kind: Any) -> bool:
    """Whether values of this type need a tag; those of "X | None" do not."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return False
    return len({*typing.get_args(kind)} - {types.NoneType}) > 1


def _attempt(node: dict[str, Any], defaults: Any) -> Exception | None:
    """Why `node` cannot be merged into `defaults`, None if it can."""
    try:
        yaml_load_typed(data=yaml_dump(node), defaults=defaults)
    except Exception as error:
        # Drake raises RuntimeError, ValueError, TypeError or AssertionError, with
        # the fault; all of them mean that the document does not fit the schema.
        return error
    return None


def _blame(
    node: Any, attempt: Callable[[Any], Exception | None], path: str = ""
) -> tuple[str, Any, str | None, Exception] | None:
    """Finds the innermost key whose value fails on its own.

    Args:
        node: What fails.
        attempt: Says why a node in the place of `node` fails, None if it does not.
        path: Where `node` is.

    Returns:
        The key's path (e.g. "policy.horizon"), its value, the tag of the mapping that
        it is in, if any, and the error; None if each part of `node` is fine.
    """
    keys: Iterable[Any] = ()
    if isinstance(node, dict):
        keys = [key for key in node if key != _TAG]
    elif isinstance(node, list):
        keys = range(len(node))
    for key in keys:

        def attempt_part(value: Any, key: Any = key) -> Exception | None:
            if isinstance(node, list):
                return attempt([value])
            # A mapping keeps its tag, which says how to read the keys.
            return attempt(_empty(node) | {key: value})

        value = node[key]
        error = attempt_part(value)
        if error is None:
            continue
        inner = f"{path}[{key}]" if isinstance(node, list) else f"{path}.{key}"
        inner = inner.removeprefix(".")
        # What fails even when empty, an unknown key or tag, is itself to blame.
        empty = _empty(value)
        deeper = None
        if empty is not None and attempt_part(empty) is None:
            deeper = _blame(value, attempt_part, inner)
        tag = node.get(_TAG) if isinstance(node, dict) else None
        return deeper or (inner, value, tag, error)
    return None


def _empty(node: Any) -> Any:
    """The mapping without its keys or the list without its items, else None."""
    if isinstance(node, dict):
        return {key: node[key] for key in node if key == _TAG}
    return [] if isinstance(node, list) else None


def _explain(
    error: Exception, key: str, value: Any, tag: str | None, defaults: Any
) -> str:
    """Drake's error in a user's words, without the full stop; see `_blame`."""
    message = str(error)
    if "unknown to the schema" in message:
        name = key.rpartition(".")[2]
        place = f" in {tag}" if tag else ""
        close = difflib.get_close_matches(name, _names(expand(defaults)), n=1)
        # A key that is known elsewhere is no misspelling.
        hint = f"; perhaps {close[0]!r} is meant" if close not in ([], [name]) else ""
        return f"there is no such key{place}{hint}"
    if "type tag" in message and isinstance(value, dict):
        known = [f"!{name}" for name in re.findall(r"(\w+)'>", message)]
        return f"{value.get(_TAG)} is none of {', '.join(known)}"
    kind = re.search(r"Expected an? <class '(\w+)'>", message)
    if kind and kind[1] in _KINDS:
        return f"expected {_KINDS[kind[1]]}, not {value!r}"
    return f"{value!r} is not a value it can have"


def _names(node: Any) -> Iterator[str]:
    """All keys in a tree of mappings and lists."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield key
            yield from _names(value)
    elif isinstance(node, list):
        for value in node:
            yield from _names(value)
