"""The page of all scenario keys, by `lieint schema`; the table of `lieint list`; the options of all commands."""

import argparse
import inspect
import json
from importlib import resources

from mkdocs.structure.files import File

from lieint_jax.app import scenarios
from lieint_jax.app.command import cli, study
from lieint_jax.app.command import list as listing
from lieint_jax.app.scenarios._kind import Kind

INTRODUCTION = """# Every scenario key

A scenario is a TOML file: a system, a scheme, a step size and an ensemble of initial states. `lieint run NAME` runs
a shipped one, `lieint run my.toml` one of your own; copy a shipped file and change it. An unknown key, a number out of
range or a text in place of a number is refused by an error that names the key. This page is made from the JSON schema
that `lieint schema` prints; an editor that knows JSON schemas can use it to complete and check your file.

Keys in **bold** must be given. A value such as `[…] × 3` is a list of three numbers. Units stand in the names of the
keys where they are fixed (`_deg`, `_km`, …); all other numbers must agree with one another, see
[Units](../howto/units.md). The table `[spread]` has, besides its own keys, those of all numbers of the scenario: see
[Clones with numbers of their own](../howto/covariance.md#in-a-scenario-file).
"""


def on_files(files, config):
    """Add the page."""
    files.append(File.generated(config, "reference/scenario_keys.md", content=_page()))
    return files


def on_page_markdown(markdown, **_):
    """Put the scenarios and studies, and the options of the commands, where a page has their marks."""
    if "<!-- lieint options -->" in markdown:
        markdown = markdown.replace("<!-- lieint options -->", options())
    return markdown.replace("<!-- lieint list -->", _listed())


def options():
    """The arguments of every command with their help, from the parser of the command line."""
    parser = cli._parser()
    [commands] = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    rows = ["### Every command", "", *_arguments(parser, [])]
    for name, command in commands.choices.items():
        own = _arguments(command, parser._actions)
        rows += ["", f"### `lieint {name}`", "", command.description, "", *(own or ["It has no arguments of its own."])]
    return "\n".join(rows)


def _arguments(parser, known):
    """The rows of a table of a parser's arguments, without those that have the options of known ones."""
    shared = {option for action in known for option in action.option_strings}
    rows = []
    for action in parser._actions:
        if shared & {*action.option_strings} or isinstance(action, argparse._SubParsersAction):
            continue
        value = parser._get_formatter()._format_args(action, action.metavar or action.dest)
        names = [f"{option} {value}".strip() for option in action.option_strings] or [value]
        rows.append(f"| {', '.join(f'`{name}`' for name in names)} | {_cell(action.help or '')} |")
    return ["| argument | |", "|---|---|", *rows] if rows else []


def _listed():
    rows = [(f"run {name}", *listing.describe(scenarios.load(name))) for name in scenarios.scenario_names()]
    rows += [
        (f"study {name}", (module.__doc__ or "").splitlines()[0], "")
        for name, module in study.studies_by_name().items()
    ]
    lines = [f"| `lieint {name}` | {what} | {size} | {listing.describe_cost(name)} |" for name, what, size in rows]
    return "\n".join(["| command | | members × steps | first run, later runs; memory |", "|---|---|---|---|", *lines])


def _page():
    schema = scenarios.schema()
    common = Kind.model_json_schema()
    parts = [INTRODUCTION, "## Keys of every scenario", _keys(common, common["properties"], {})]
    published = schema["$defs"]["Published"]
    parts += ["### `[published.NAME]`", "A number to compare with, in the table `published` of some kinds of system."]
    parts += [_keys(published, published["properties"], {})]
    models = {name: _resolved(schema, ref) for name, ref in zip(scenarios.kinds(), schema["oneOf"], strict=True)}
    for name, model in models.items():
        own = {key: value for key, value in model["properties"].items() if value != common["properties"].get(key)}
        del own["system"]
        shipped = [x for x in scenarios.scenario_names() if scenarios.load(x).system == name]
        parts += [f'## `system = "{name}"`', _summary(inspect.getmodule(scenarios.kinds()[name]))]
        parts += [_keys(model, own, schema["$defs"])]
        parts += [_example(x) for x in shipped]
        parts += _tables(schema, own, [])
    return "\n\n".join(parts) + "\n"


def _summary(module):
    """The first two paragraphs of its docstring: what it reports, and its units."""
    return "\n\n".join((module.__doc__ or "").strip().split("\n\n")[:2])


def _example(name):
    text = resources.files("lieint_jax.app.scenarios").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    indented = "\n".join(f"    {line}".rstrip() for line in f"```toml\n{text.strip()}\n```".splitlines())
    return f'??? example "The shipped scenario {name}"\n\n{indented}'


def _tables(schema, properties, path):
    """The tables inside a table, each with its heading and keys, and those inside them."""
    parts = []
    for key, value in properties.items():
        for inner in _inner(schema, value):
            name = ".".join([*path, key])
            heading = f"[[{name}]]" if value.get("type") == "array" else f"[{name}]"
            heading = f'{name} = {{file = "…"}}' if "file" in inner["properties"] else heading
            parts += [f"### `{heading}`", " ".join(inner.get("description", "").split())]
            parts += [_keys(inner, inner["properties"], schema["$defs"])]
            parts += _tables(schema, inner["properties"], [*path, key])
    return parts


def _inner(schema, value):
    """The models of the tables that a key may be, or of which it may be a list."""
    options = [value, value.get("items", {}), value.get("additionalProperties", {}), *value.get("anyOf", [])]
    models = [_resolved(schema, x) if "$ref" in x else x for x in options if isinstance(x, dict)]
    return [x for x in models if "properties" in x and x["title"] != "Published"]


def _resolved(schema, ref):
    return schema["$defs"][ref["$ref"].rpartition("/")[2]]


def _keys(model, properties, definitions):
    rows = ["| key | value | default | |", "|---|---|---|---|"]
    for key, value in properties.items():
        name = f"**`{key}`**" if key in model.get("required", ()) else f"`{key}`"
        cells = (name, _kind(value, definitions), _default(value), _cell(value.get("description", "")))
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _kind(value, definitions):
    """The values that a key takes, in short."""
    if "$ref" in value:
        return "table"
    if "anyOf" in value:
        return " or ".join(dict.fromkeys(_kind(x, definitions) for x in value["anyOf"] if x.get("type") != "null"))
    if "enum" in value or "const" in value:
        return ", ".join(f"`{json.dumps(x)}`" for x in value.get("enum", [value.get("const")]))
    if value.get("type") == "array":
        return _list(value, definitions)
    if value.get("type") == "object":
        names = value.get("propertyNames", {})
        known = names.get("enum") or ([names["const"]] if "const" in names else [])
        return "table" + (f" of {', '.join(f'`{x}`' for x in known)}" if known else "")
    return {"string": "text", "number": "number", "integer": "integer", "boolean": "`true`, `false`"}[
        value["type"]
    ] + _range(value)


def _list(value, definitions):
    if not value["items"]:
        return "`[…] × 3` or `[[…] × 3] × 3`"
    if "$ref" in value["items"]:
        return "list of tables"
    size = f" × {value['minItems']}" if "minItems" in value and value["minItems"] == value.get("maxItems") else ""
    if value["items"].get("type") == "array":
        return f"`[{_list(value['items'], definitions).strip('`')}]{size}`"
    numbers = value["items"].get("type") in ("number", "integer")
    return f"`[…]{size}`" if numbers else f"list of {_kind(value['items'], definitions)}"


def _range(value):
    signs = (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤"))
    found = [f"{sign}\u00a0{_number(value[name])}" for name, sign in signs if name in value and abs(value[name]) < 1e9]
    if "multipleOf" in value:
        found.append(f"a multiple of {value['multipleOf']}")
    return f"\u00a0{', '.join(found)}" if found else ""


def _number(x):
    return str(int(x)) if x == int(x) else str(x)


def _default(value):
    default = value.get("default")
    return "" if default is None or default in ({}, []) or isinstance(default, dict) else f"`{json.dumps(default)}`"


def _cell(text):
    return " ".join(text.split()).replace("|", "\\|")
