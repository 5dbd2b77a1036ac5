"""The table of `lieint list`, and the arguments of all commands, where a page has their marks."""

import inspect

import docstring_parser

from lieint_jax.command import cli, listing, scripts

OWN_NAMES = {"first": "from", "last": "to"}  # options that are words of Python


def on_page_markdown(markdown, **_):
    """Put `<!-- lieint list -->` and `<!-- lieint options -->` in place."""
    if "<!-- lieint options -->" in markdown:
        markdown = markdown.replace("<!-- lieint options -->", options())
    return markdown.replace("<!-- lieint list -->", _listed()) if "<!-- lieint list -->" in markdown else markdown


def options():
    """The arguments of every command but `run`, whose arguments are those of a script, with their help."""
    parts = []
    for name in cli.COMMANDS:
        if name != "run":
            function = cli._function(name)
            about = docstring_parser.parse(inspect.getdoc(function))
            rows = [f"| {_name(function, x.arg_name)} | {_cell(x.description)} |" for x in about.params]
            parts.append("\n".join([f"### `lieint {name}`\n\n{about.short_description}\n", "| | |\n|---|---|", *rows]))
    return "\n\n".join(parts)


def _name(function, argument):
    """An argument as it is typed."""
    annotation = str(inspect.signature(function).parameters[argument].annotation)
    if "Positional" in annotation:
        return f"`{argument.upper()}`"
    option = f"--{OWN_NAMES.get(argument, argument)}"
    kind = next((word for word in ("Path", "int", "float", "str") if word in annotation), "").upper()
    return f"`{option} {kind}`" if kind else f"`{option}`"


def _listed():
    rows = [(name, *listing.describe(name), listing.describe_cost(f"run {name}")) for name in scripts.names()]
    lines = [
        f"| [`{name}`](../gallery/{name}.md) | {_cell(about)} | {size.strip('; ')} | {cost} |"
        for name, about, size, cost in rows
    ]
    head = "| `lieint run …` | | members × steps | first run, later runs; memory |\n|---|---|---|---|"
    return "\n".join([head, *lines])


def _cell(text):
    return " ".join(text.split()).replace("|", "\\|")
