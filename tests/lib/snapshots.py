"""What the application printed and wrote when its snapshots were made: `tests/data/snapshots`, a text of each command.

`python tests/lib/snapshots.py [NAME …]` makes them again, of all commands or of some. Runs have few members, as many
steps as a user's, and no certificate. There is none of two chaotic motions, `run hyperion` and the droplet of `run
water`: any other rounding, such as that of another processor, changes what they print.
"""

import contextlib
import io
import json
import re
import sys
import tempfile
from pathlib import Path

import jax

from lieint_jax.app import scenarios
from lieint_jax.app.command import files, run, study
from lieint_jax.app.command import list as listed

FOLDER = Path(__file__).parents[1] / "data" / "snapshots"
CHAOTIC = ("hyperion", "water")
MEMBERS = {"pluto_charon": 1, "driven": 1}  # of the others 3; further members of `run driven` move chaotically
NUMBER = re.compile(r"(?<![\w.])[-−+]?\d+(?:\.\d+)?(?:e[-+]\d+)?(?!\w)")
_ROUND_OFF = 1e-9  # a smaller number is one of rounding, which differs between compilers
_RELATIVE = 1e-6


def commands():
    """The commands of which there are snapshots."""
    return [
        "list",
        "schema",
        *(f"run-{name}" for name in scenarios.scenario_names() if name not in CHAOTIC),
        *(f"study-{name}" for name in study.studies_by_name()),
    ]


def path(command):
    """The file of a command's snapshot."""
    return FOLDER / f"{command}.txt"


def text(command):
    """What a command prints, and the names of the files that it writes."""
    kind, _, name = command.partition("-")
    return {"list": _list, "schema": _schema, "run": _run, "study": _study}[kind](*[name] * bool(name))


def difference(found, kept):
    """The first line in which two texts differ, both versions, or "". Numbers differ from a millionth on.

    As printed: one unit in the last digit counts as none. All numbers below 1e-9 are the same.
    """
    lines, others = found.splitlines(), kept.splitlines()
    for line, other in zip(lines, others, strict=False):
        same_words = _words(line) == _words(other)
        if not same_words or not all(map(_is_same, NUMBER.findall(line), NUMBER.findall(other))):
            return f"{line!r}\nwas\n{other!r}"
    return "" if len(lines) == len(others) else f"{len(lines)} lines, not {len(others)}"


def _words(line):
    """A line without its numbers, and with any spaces as one: the width of a column may depend on a sign."""
    return re.sub(r" +", " ", NUMBER.sub("#", line))


def _is_same(a, b):
    x, y = (float(number.replace("−", "-")) for number in (a, b))
    mantissa, _, exponent = b.partition("e")
    last = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return max(abs(x), abs(y)) < _ROUND_OFF or abs(x - y) <= max(_RELATIVE * abs(y), 1.01 * last)


def _list():
    return re.sub(r"(^ {22}|; )[0-9 mins,]+; [\d.]+ GB", r"\1(cost)", listed.text(), flags=re.M)


def _schema():
    """The keys of all kinds, with their defaults and what they mean."""
    models = scenarios.schema()["$defs"]
    keys = [(f"{model}.{key}", x) for model, found in sorted(models.items()) for key, x in found["properties"].items()]
    default = lambda x: json.dumps(x["default"]) if "default" in x else "required"  # noqa: E731
    return "\n".join(f"{name} = {default(x)}: {x.get('description', '')}" for name, x in keys)


def _run(name):
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()) as printed:
        out = Path(folder) / f"{name}.npz"
        run.run(name, out, members=MEMBERS.get(name, 3), certificate=False, pictures=False)
        drawings = scenarios.load(name).pictures()
        drawn = [picture.name for picture in files.pictures(out, drawings)]
    without_size = re.sub(r"; [\d.]+ MB\)", ")", printed.getvalue())
    return without_size.replace(f"{folder}/", "") + f"pictures: {', '.join(drawn)}\n"


def _study(name):
    module = study.studies_by_name()[name]
    return re.sub(r": \d+ s(?= on|$)", ": (time)", module.text(module.run(quick=True, progress=False)), flags=re.M)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    FOLDER.mkdir(exist_ok=True)
    for each in sys.argv[1:] or commands():
        path(each).write_text(text(each).rstrip("\n") + "\n", encoding="utf-8")
        print(each)
