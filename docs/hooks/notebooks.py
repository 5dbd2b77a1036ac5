"""The notebooks as pages of the site: their text, code and outputs as they are in the files; nothing is run.

Code with lines longer than a page is wide is formatted again, for that width.
"""

import base64
import json
import subprocess
import sys
from pathlib import Path

from mkdocs.structure.files import File

FOLDER = Path(__file__).parents[2] / "notebooks"
WIDTH = 94  # characters of a line of code, in a window of 1280 pixels


def on_files(files, config):
    """Add a page for every notebook, and its pictures."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        text, pictures = _page(path)
        files.append(File.generated(config, f"tutorials/{path.stem}.md", content=text))
        for name, data in pictures.items():
            files.append(File.generated(config, f"tutorials/{name}", content=data))
    return files


def _page(path):
    """The Markdown of a notebook, and its pictures by name."""
    parts, pictures = [], {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(_fenced("python", _fitted(source)))
        for output in _merged(cell["outputs"]):
            parts.append(_output(output, path.stem, pictures))
    title, *rest = parts
    run = f"*This page is the notebook `notebooks/{path.name}`; download it from the repository to run it.*"
    heading, _, body = title.partition("\n")
    return "\n\n".join([heading, run, body.strip(), *rest]), pictures


def _fitted(source):
    """Code whose lines fit the page; as it is if they do, or if it is no pure Python."""
    if max(map(len, source.splitlines()), default=0) <= WIDTH:
        return source
    command = [sys.executable, "-m", "ruff", "format", "--isolated", "--line-length", str(WIDTH), "-"]
    formatted = subprocess.run(command, input=source, capture_output=True, text=True, encoding="utf-8")
    return source if formatted.returncode else formatted.stdout


def _merged(outputs):
    """The outputs of a cell, where what one after the other is printed is one text."""
    merged = []
    for output in outputs:
        printed = output["output_type"] == "stream" and merged and merged[-1].get("name") == output["name"]
        if printed:
            merged[-1] = merged[-1] | {"text": [*merged[-1]["text"], *output["text"]]}
        else:
            merged.append(output)
    return merged


def _output(output, stem, pictures):
    """The Markdown of one output: a picture if it has one, else text."""
    if output["output_type"] == "stream":
        return _fenced("text", "".join(output["text"])) if output["name"] == "stdout" else ""
    data = output["data"]
    if "image/png" in data:
        name = f"{stem}-{len(pictures) + 1}.png"
        pictures[name] = base64.b64decode(data["image/png"])
        return f"![The picture that this cell draws]({name})"
    return _fenced("text", "".join(data["text/plain"]))


def _fenced(language, text):
    return f"```{language}\n{text.rstrip()}\n```"
