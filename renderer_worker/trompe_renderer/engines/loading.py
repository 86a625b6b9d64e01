"""Engines by name: ours, and anybody's own as ``module:Class``. Their options come as text."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from inspect import Parameter, signature
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import click

from trompe_renderer.engines.engine import Engine
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import ProtocolError, RendererError

ENGINES: Final[Mapping[str, tuple[str, str]]] = {
    "pyrender": ("pyrender.engine:PyrenderEngine", "pip install 'trompe[renderer]'"),
    "three": ("three.engine:ThreeEngine", "pip install 'trompe[three]'"),
    "panda3d": ("panda3d:Panda3dEngine", "pip install 'trompe[panda3d]'"),
    "mitsuba": ("mitsuba:MitsubaEngine", "pip install 'trompe[mitsuba]'"),
    "cycles": ("cycles.engine:CyclesEngine", "pip install 'trompe[cycles]'"),
}
"""Class of each engine in this package, as module:Class, and the command that installs what it needs."""


def engine_maker(name: str, settings: Mapping[str, str]) -> Callable[[], Engine]:
    """What creates the engine ``name`` with ``settings``, option values by name.

    The engine's ``info`` then has this name, and the settings that differ from the defaults. Options are the fields of
    the frozen dataclass that the class takes as its only parameter, or else the class's parameters; a field that is not
    compared changes no picture and is no setting. Raises ``RendererError`` for an unknown engine, a missing package, an
    unknown option and a wrong value.
    """
    kind = _engine_class(name)
    options = _options_class(kind)
    values, changed = _values(name, options or kind, settings)

    def make() -> Engine:
        engine: Engine = kind(options(**values)) if options else kind(**values)
        try:
            info = EngineInfo.from_text(engine.info.to_text())
            engine.info = replace(info, name=name, settings=", ".join(filter(None, [info.settings, *changed])))
        except (AttributeError, TypeError, ProtocolError) as error:
            raise RendererError(
                f"The engine {name} needs an attribute `info`, an EngineInfo of texts that can be replaced: {error}"
            ) from error
        return engine

    return make


def _engine_class(name: str) -> Callable[..., Any]:
    if name in ENGINES:
        path, command = ENGINES[name]
        return _imported(name, f"trompe_renderer.engines.{path}", f"Install it: {command}")
    module, _, attribute = name.partition(":")
    if not attribute:
        raise RendererError(f"There is no engine {name!r}. Choose {', '.join(ENGINES)}, or your own as module:Class.")
    sys.path.insert(0, "")  # as `python -m` does: a module in the working directory
    return _imported(name, name, f"Run the command in the folder of {module}, or set PYTHONPATH.")


def _imported(name: str, path: str, remedy: str) -> Callable[..., Any]:
    module, _, attribute = path.partition(":")
    try:
        found: Callable[..., Any] | None = getattr(import_module(module), attribute, None)
    except ImportError as error:
        raise RendererError(f"The engine {name} cannot be imported ({error}). {remedy}") from error
    if found is None or not callable(getattr(found, "render", None)):
        raise RendererError(f"{name} is not an engine: a class with a method `render` (docs/engines.md).")
    return found


def _options_class(kind: Any) -> Any:
    """The dataclass that ``kind`` takes as its only parameter, if it does."""
    (only, *others) = *signature(kind).parameters, None
    hint = _hints(kind).get(only or "")
    return hint if others == [None] and isinstance(hint, type) and is_dataclass(hint) else None


def _values(name: str, takes: Any, settings: Mapping[str, str]) -> tuple[dict[str, Any], list[str]]:
    """Values by option, and ``option=value`` of those compared that differ from the defaults."""
    hints = _hints(takes)
    variadic = Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD
    known = {each.name: each for each in signature(takes).parameters.values() if each.kind not in variadic}
    kinds = {option: _click_type(hints.get(option), each.default) for option, each in known.items()}
    listed = ", ".join(_described(each, kinds[each.name]) for each in known.values()) or "none"
    values = {}
    for option, text in settings.items():
        if option not in known:
            raise RendererError(f"The engine {name} has no option {option!r}. Its options: {listed}.")
        try:
            values[option] = kinds[option].convert(text, None, None)
        except click.BadParameter as error:
            raise RendererError(f"--set {option}: {error.message} Options of {name}: {listed}.") from error
    missing = [each.name for each in known.values() if each.default is Parameter.empty and each.name not in values]
    if missing:
        raise RendererError(f"The engine {name} needs --set {missing[0]}=VALUE. Its options: {listed}.")
    same = {each.name for each in fields(takes) if not each.compare} if is_dataclass(takes) else set()
    changed = [option for option, value in values.items() if value != known[option].default and option not in same]
    return values, [f"{option}={values[option]}" for option in changed]


def _hints(kind: Any) -> dict[str, Any]:
    """Types of the parameters of a class."""
    try:
        return get_type_hints(kind.__init__, include_extras=True)
    except NameError as error:
        raise RendererError(
            f"The option types of {kind.__name__} are unknown ({error}): import them not only for type checkers."
        ) from error


def _click_type(hint: Any, default: Any) -> "click.ParamType[Any]":
    """The click type of an annotation (of a union: of its last type but None), or of a default without one."""
    if get_origin(hint) in {Union, UnionType}:
        *_, hint = (each for each in get_args(hint) if each is not NoneType)
    kind: click.ParamType[Any] = click.types.convert_type(hint, None if default is Parameter.empty else default)
    if get_origin(hint) is Literal:
        kind = click.Choice(get_args(hint))
    if get_origin(hint) is Annotated:
        inner, *extra = get_args(hint)
        kind = next((each for each in extra if isinstance(each, click.ParamType)), _click_type(inner, default))
    return kind


def _described(option: Parameter, kind: "click.ParamType[Any]") -> str:
    text = kind.name
    if isinstance(kind, click.Choice):
        text = "|".join(map(str, kind.choices))
    if isinstance(kind, click.IntRange | click.FloatRange):
        text = f"{kind.min} to {kind.max}"
    return f"{option.name} ({text}" + ("" if option.default is Parameter.empty else f", default {option.default}") + ")"
