"""The gallery: a page for each script of `lieint_jax.examples`, with what it prints and a picture that it draws.

The scripts run when the site is built, at sizes that need seconds; one that fails fails the build. What they print and
draw stays in the user's cache as long as neither the script nor the package changes.
"""

import ast
import hashlib
import os
import pkgutil
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from platformdirs import user_cache_path

import lieint_jax
from lieint_jax import examples

# The older emitters of XLA's CPU compiler, which jaxlib has up to 0.10, compile in a third of the time.
OLD = "--xla_cpu_use_fusion_emitters=false"
QUICKLY = OLD if jax.__version_info__ < (0, 11) else ""
PACKAGE, FOLDER = Path(lieint_jax.__file__).parent, Path(examples.__path__[0])
CACHE = user_cache_path("lieint", appauthor=False) / "gallery"
NAMES = sorted(module.name for module in pkgutil.iter_modules(examples.__path__))
INTRODUCTION = """# Gallery

Each of these scripts is a simulation, a fit or a figure of the paper. `lieint run NAME` runs it, `lieint list NAME`
prints it, and [The command line](reference/command_line.md#a-script-of-your-own) describes how to make your own from a
copy. The pictures were drawn when this site was built, many with fewer members and steps than by default.
"""
SIZES = {  # options of scripts that need longer without them
    "apophis": "--members 400 --phases 12",
    "cubesat": "--members 8",
    "didymos": "--members 20 --no-certificate",
    "driven": "--members 20 --steps 4000 --no-certificate",
    "gyro": "--trials 20",
    "hyperion": "--members 480 --steps 6000 --spatial-starts 4 --orbits 200",
    "kappa": "--training 50 --unseen 100 --runs 4 --steps 100",
    "kirchhoff": "--no-certificate",
    "kw4": "--members 20 --no-certificate",
    "maclaurin": "--members 30 --no-certificate",
    "moon_tides": "--no-certificate",
    "pendulum": "--no-certificate",
    "pluto_charon": "--no-certificate",
    "pseudo_rigid": "--members 20 --no-certificate",
    "satellite_fit": "--guesses 5000 --starts 40",
    "sensitivity": "--steps 5000",
    "sn263": "--members 5 --no-certificate",
    "toutatis": "--steps 16000",
    "toutatis_fit": "--sets 10 --members 100",
    "toutatis_flyby": "--members 200",
    "water": "--steps 200 --molecules 8",
}


def on_config(config):
    """Put the pages below the gallery in the navigation."""
    for entry in config.nav:
        if "Gallery" in entry:
            entry["Gallery"] += [f"gallery/{name}.md" for name in NAMES]
    return config


def on_files(files, config):
    """Add the gallery, the page of each script and its picture."""
    with ThreadPoolExecutor(min(8, lieint_jax.count_cores())) as pool:
        made = dict(zip(NAMES, pool.map(results, NAMES), strict=True))
    pages = {"gallery.md": _gallery(), **{f"gallery/{name}.md": _page(name, made[name]) for name in NAMES}}
    for uri, text in pages.items():
        files.append(File.generated(config, uri, content=text))
    for name, folder in made.items():
        files.append(File.generated(config, f"gallery/{name}.png", abs_src_path=str(folder / "picture.png")))
    return files


def results(name):
    """The folder with what a script printed, output.txt, and its first picture, picture.png; it runs if it must."""
    made = CACHE / f"{name}-{_key(name)}"
    if not (made / "picture.png").is_file():  # which is written last
        with tempfile.TemporaryDirectory() as folder:
            printed = _run(name, Path(folder))
            picture = Path(folder, _picture(name, printed))
            for old in CACHE.glob(f"{name}-" + "?" * 16):
                shutil.rmtree(old)
            made.mkdir(parents=True, exist_ok=True)
            (made / "output.txt").write_text(printed, encoding="utf-8")
            shutil.copy(picture, made / "picture.png")
    return made


def _key(name):
    """A digest of everything that a script's output may depend on."""
    files = [x for x in PACKAGE.rglob("*") if x.is_file() and x.suffix != ".pyc" and x.parent != FOLDER]
    files += [FOLDER / f"{name}.py", *sorted(FOLDER.glob("*.csv"))]
    digest = hashlib.sha256(f"{sys.version} {jax.__version__} {SIZES.get(name)}".encode())
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _run(name, folder):
    command = [sys.executable, "-m", f"lieint_jax.examples.{name}", *shlex.split(SIZES.get(name, ""))]
    environment = os.environ | {"PYTHONIOENCODING": "utf-8", "XLA_FLAGS": QUICKLY, "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", cwd=folder, env=environment)
    if done.returncode:
        raise PluginError(f"{shlex.join(command[1:])} failed:\n{done.stderr}")
    return done.stdout


def _picture(name, printed):
    """The first picture that a script reports."""
    for line in printed.splitlines():
        if line.startswith("pictures:"):
            return next(word for word in line.split() if word.endswith(".png"))
    raise PluginError(f"the script {name} reports no picture")


def _text(name):
    return (FOLDER / f"{name}.py").read_text(encoding="utf-8")


def _about(name):
    """The title of a script, what it shows, and the other paragraphs of its docstring."""
    first, _, rest = ast.get_docstring(ast.parse(_text(name))).partition("\n")
    title, _, shown = first.rstrip(".").partition(": ")
    return title, shown, rest.strip()


def _gallery():
    parts = [INTRODUCTION, '<div class="gallery" markdown>']
    for name in NAMES:
        title, shown, _ = _about(name)
        picture = f"[![{title}](gallery/{name}.png)](gallery/{name}.md)"
        parts.append(f"<div markdown>\n\n{picture}\n\n[**{title}**](gallery/{name}.md): {shown}\n\n</div>")
    return "\n\n".join([*parts, "</div>"]) + "\n"


def _page(name, folder):
    title, shown, rest = _about(name)
    printed = (folder / "output.txt").read_text(encoding="utf-8")
    options = f" {SIZES[name]}" if name in SIZES else ""
    return "\n\n".join(
        [
            f"# {title}",
            f"{shown[0].upper()}{shown[1:]}. {rest}",
            f"![A picture that the script draws]({name}.png)",
            f"```sh\nlieint run {name}{options}\n```\n\n```text\n{printed.rstrip()}\n```",
            f"## The script\n\n`lieint list {name}` prints it.\n\n```python\n{_text(name).rstrip()}\n```\n",
        ]
    )
