"""What the site's builder makes of docstrings and signatures, so that `help()` shows them without brackets.

Names in backquotes become links, as do pages; classes get a signature from their fields; a type that has a name within
jaxhf stands there in full.
"""

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe

ROOT = Path(__file__).parents[1]
STUBS = {"jaxhf": "jaxhf/__init__.pyi", "jaxhf.mujoco": "jaxhf/mujoco/__init__.py"}


def public_names() -> dict[str, str]:
    """From each public name, as `Scene`, to where it stands on the API's pages, as `jaxhf.Scene`; nothing is imported."""
    return {
        alias.asname: f"{module}.{alias.asname}"
        for module, path in STUBS.items()
        for node in ast.walk(ast.parse((ROOT / path).read_text()))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname and alias.name != "mujoco"
    }


NAMES = public_names()
NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"


def _pages_linked(text: str) -> str:
    """The text with a link, under the page's title, at each page that it names, as docs/concepts/walk.md; for pages of api/."""

    def link(match: re.Match[str]) -> str:
        title = (ROOT / match[0]).read_text().splitlines()[0].removeprefix("# ")
        return f"[{title}](../{match[1]})"

    return re.sub(r"docs/([\w/-]+\.md)", link, text)


class Docstrings(griffe.Extension):
    """Called by the site's builder once it has read the package, before it makes pages."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        mujoco = pkg["mujoco"]
        mujoco.set_member("ray", griffe.Alias("ray", mujoco["ray.ray"], parent=mujoco))  # else the module of that name
        public = {name: pkg[path.removeprefix("jaxhf.")].final_target for name, path in NAMES.items()}
        _describe_settings(public["Settings"])
        for thing, signature in [(thing, _signature(thing)) for thing in public.values() if thing.is_class]:
            if signature is not None:
                thing.set_member("__init__", signature)
        for thing in public.values():
            for part in (thing, *_members(thing)):
                _spell_out(part, pkg)
                if part.docstring is not None:
                    part.docstring.value = _tidy(part, thing.name, public)


def _describe_settings(settings: Any) -> None:
    """Its fields describe themselves, by `_setting(default, rule, help, none=...)`; their defaults stand for these calls."""
    lines = []
    for field in settings.members.values():
        if field.is_attribute and str(field.value).startswith("_setting("):
            default, _, words, *options = field.value.arguments
            none = "".join(f"; None: {_string(option.value)}" for option in options if option.name == "none")
            lines.append(f"  {field.name}: {_string(words)}{none}.")
            field.value = default
    settings.docstring.value += "\n\nAttributes:\n" + "\n".join(lines)


def _string(expression: Any) -> str:
    return ast.literal_eval(str(expression))


def _members(thing: Any) -> Iterator[Any]:
    return (member for member in thing.members.values() if not member.is_alias) if thing.is_class else iter(())


def _tidy(thing: Any, own: str, public: dict[str, Any]) -> str:
    """A docstring with its links, and with the types of attributes that share a line, which the builder takes for one."""

    def link(match: re.Match[str]) -> str:
        name, _, member = match[1].removeprefix("jaxhf.").removeprefix("mujoco.").partition(".")
        if name not in public or (name == own and not member):
            return match[0]
        place = NAMES[name]
        has_heading = public[name].is_class and member in public[name].members and public[name][member].docstring
        return f"[{match[0]}][{place}.{member}]" if has_heading else f"[{match[0]}][{place}]"

    def typed(match: re.Match[str]) -> str:
        names = match[1].split(", ")
        types = dict.fromkeys(str(thing.all_members[name].annotation) for name in names)
        return f"  {f',{NO_BREAK_SPACE}'.join(names)} ({', '.join(types)}):"

    head, mark, attributes = thing.docstring.value.partition("\nAttributes:\n")
    attributes = re.sub(r"^  (\w+(?:, \w+)+):", typed, attributes, flags=re.M)
    return _pages_linked(re.sub(r"`([A-Za-z_][\w.]*)`", link, head + mark + attributes))


def _signature(thing: Any) -> griffe.Function | None:
    """The `__init__` of a class of equinox's, of its fields, first those of the classes that it is made of; None of others."""
    classes = [*reversed(thing.mro()), thing]
    known = any("Module" in str(base) for each in classes for base in each.bases)
    if not known or any("__init__" in each.members for each in classes):
        return None
    parameters: dict[str, griffe.Parameter] = {}
    for field in (member for each in classes for member in each.members.values()):
        if not field.is_attribute or field.annotation is None or "property" in field.labels:
            continue
        options = {}
        if isinstance(field.value, griffe.ExprCall) and str(field.value.function).endswith("field"):
            options = {each.name: each.value for each in field.value.arguments if isinstance(each, griffe.ExprKeyword)}
        if not field.name.startswith("_"):
            kind = griffe.ParameterKind.keyword_only if "kw_only" in options else griffe.ParameterKind.positional_or_keyword
            default = options.get("default", None if options else field.value)
            parameters[field.name] = griffe.Parameter(field.name, annotation=field.annotation, kind=kind, default=default)
        elif "default" not in options:
            return None  # no user makes it
    return griffe.Function("__init__", parameters=griffe.Parameters(*parameters.values()), parent=thing)


def _spell_out(thing: Any, pkg: griffe.Module) -> None:
    """Puts the types themselves in place of their names within jaxhf."""
    if thing.is_attribute:
        thing.annotation = _in_full(thing.annotation, pkg)
    elif thing.is_function:
        thing.returns = _in_full(thing.returns, pkg)
        for parameter in thing.parameters:
            parameter.annotation = _in_full(parameter.annotation, pkg)


def _in_full(expression: Any, pkg: griffe.Module) -> Any:
    if isinstance(expression, list | tuple):
        return type(expression)(_in_full(part, pkg) for part in expression)
    if not isinstance(expression, griffe.Expr):
        return expression
    if isinstance(expression, griffe.ExprName) and expression.canonical_path.startswith("jaxhf."):
        meant = pkg[expression.canonical_path.removeprefix("jaxhf.")]
        return _in_full(meant.value, pkg) if meant.is_attribute else expression
    fields = {field.name: _in_full(getattr(expression, field.name), pkg) for field in dataclasses.fields(expression)}
    return dataclasses.replace(expression, **fields)
