"""Options of commands: what signature and docstring of a function say, read from its file, of which nothing is run.

An annotation is a type (a flag is a `bool`), or a `Literal` of words; `Annotated` gives it a kind of value
(`values.py`), its name in help, and in texts that begin with `--` further spellings of the option. An argument without
`*` before it is one of the command line; a `Sequence` may be given several times.
"""

import ast
import re
import types
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import click

from afm_jax.cli import values
from afm_jax.cli.values import Finite, option_of

_NAMES = {"IntRange": click.IntRange, "Path": Path, "Sequence": Sequence, **vars(values)}
"""What annotations are made of."""
_KINDS = {float: Finite(), int: click.INT, str: click.STRING, Path: click.Path(path_type=Path)}
SCENE = click.Argument(["scene"], metavar="SCENE.toml|PRESET", type=click.Path())
"""The scene that is loaded before the command's function is called, which gets it as a `NamedScene`."""
LAW = click.Option(
    ["--law"],
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A fit's fit.json or law.csv, a law.json of `collide --make-law`, or a CSV of measured speeds: its law in "
    "place of the scene's, its errors as bands.",
)
"""With a scene it is loaded, too: the scene has its law then."""


@cache
def described(place: str) -> tuple[str, tuple[click.Parameter, ...]]:
    """Return what the docstring of a function says, and the arguments and options that it has.

    Args:
        place: "module:function", or "module:class" of a class whose attributes are options; a module that begins with a
            point is of this folder. The first argument of a function is the session.
    """
    module, _, name = place.partition(":")
    spec = find_spec(module, __package__)
    assert spec is not None and spec.origin is not None, place  # noqa: PT018, S101
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    node: Any = next(each for each in tree.body if getattr(each, "name", "") == name)
    text, _, rest = re.sub(r"\n\nAttributes:\n", "\n\nArgs:\n", ast.get_docstring(node) or "").partition("\n\nArgs:\n")
    meanings = dict(re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", rest, re.MULTILINE))
    return text, tuple(_parameter(*each, _sentence(meanings.get(each[0], ""))) for each in _arguments(node))


def _sentence(text: str) -> str:
    text = " ".join(text.split())
    return text[:1].upper() + text[1:]


def _arguments(node: Any) -> Iterator[tuple[str, Any, ast.expr | None, bool]]:
    """Give name, annotation, default and whether it needs no name, of what a function takes or a class has."""
    if isinstance(node, ast.ClassDef):
        for each in node.body:
            if isinstance(each, ast.AnnAssign):
                yield ast.unparse(each.target), each.annotation, each.value, False
        return
    bare, named = node.args.args[1:], node.args.kwonlyargs
    defaults = [None] * (len(bare) - len(node.args.defaults)) + node.args.defaults[-len(bare) :] if bare else []
    for each, value in zip((*bare, *named), (*defaults, *node.args.kw_defaults), strict=True):
        yield each.arg, each.annotation, value, each in bare


def _parameter(name: str, annotation: ast.expr, value: ast.expr | None, bare: bool, meaning: str) -> click.Parameter:  # noqa: FBT001
    if ast.unparse(annotation) == "NamedScene":
        return SCENE
    plain, details = _unwrapped(eval(ast.unparse(annotation), _NAMES))  # noqa: S307 (of our own files)
    several = get_origin(plain) is Sequence
    plain = get_args(plain)[0] if several else plain
    words = [each for each in details if isinstance(each, str)]
    kind: Any = next((each for each in details if isinstance(each, click.ParamType)), None) or (
        click.Choice(get_args(plain)) if get_origin(plain) is Literal else _KINDS.get(plain)
    )
    more: dict[str, Any] = {"metavar": next((word for word in words if not word.startswith("--")), None), "type": kind}
    default = None if value is None else ast.literal_eval(value)
    if bare:
        return click.Argument([name], nargs=-1 if several else 1, required=value is None and not several, **more)
    spelled = [word for word in words if word.startswith("--")]
    if plain is bool:
        return click.Option([name, *spelled, option_of(name)], is_flag=True, help=meaning)
    if several or default is not None:
        # of several values help says it in words
        in_help = default != "" and not isinstance(default, tuple)
        more |= {"default": default, "multiple": several, "show_default": in_help}
    return click.Option([name, *spelled, option_of(name)], required=value is None, help=meaning, **more)


def _unwrapped(hint: Any) -> tuple[Any, list[Any]]:
    """Return a type without `Annotated` and `None` around it, and what was annotated."""
    if get_origin(hint) is Annotated:
        plain, details = _unwrapped(hint.__origin__)
        return plain, [*details, *hint.__metadata__]
    if get_origin(hint) in (Union, types.UnionType):
        return _unwrapped(next(each for each in get_args(hint) if each is not types.NoneType))
    return hint, []
