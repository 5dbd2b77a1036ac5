"""Files of results that are damaged or crafted: every command that reads them answers with one line and exit code 2."""

import io
import json
import os
import resource
import shutil
import stat
import struct
import warnings
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest
from internals import write_root

import lieint_jax as li
from lieint_jax.command import cli

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
_MEMORY = 300e6  # bytes, the most that all the cases of a test may add: one that is believed asks for more


def files_of(folder):
    """The bytes of the ordinary files in a folder, by name."""
    found = sorted(file for file in folder.rglob("*") if file.is_file())
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in found}


def packed(files, method=zipfile.ZIP_STORED, name="{}", change=lambda infos: None):
    """The bytes of a zip file of `files`; `change` alters what its directory says of them."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that occur twice
        for key, data in files.items() if isinstance(files, dict) else files:
            archive.writestr(name.format(key), data)
        change({info.filename: info for info in archive.filelist})
    return stream.getvalue()


def patched(raw, offset, value):
    """`raw` with two bytes at an offset behind the mark of every header of a file, local and central."""
    found = bytearray(raw)
    for mark, shift in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        at = found.find(mark)
        while at >= 0:
            struct.pack_into("<H", found, at + shift + offset, value)
            at = found.find(mark, at + 4)
    return bytes(found)


def altered(name, **values):
    """A change of what the directory of a zip file says of one of its files."""

    def change(infos):
        for key, value in values.items():
            setattr(infos[name], key, value)

    return change


def zips(good):
    """The bytes of crafted zip files, by what is wrong with them."""
    files = files_of(good)
    raw, chunk = packed(files), "q/c/0/0/0"
    yield from ((f"cut at {k}/8", raw[: len(raw) * k // 8]) for k in range(8))
    for name in files:
        yield f"without {name}", packed({key: data for key, data in files.items() if key != name})
        yield f"{name} is empty", packed(files | {name: b""})
        yield f"{name} is damaged", raw.replace(files[name], bytes(len(files[name])))
    for name in ("../{}", "/{}", "a/{}", "..\\{}", "./{}", "{}/", "{}/..", "a//{}", "C:/{}", "{}\x1b", ".{}"):
        yield f"names {name!r}", packed(files, name=name)
    for text in ("../x", "/etc/x", "q/../../x", "q\\x", "q//x"):
        yield f"also a file {text!r}", packed(files | {text: b"x"})
    yield "folders of their own", packed(files | {"q/": b""})
    yield "a name twice", packed([*files.items(), (chunk, files[chunk])])
    for kind in (stat.S_IFLNK, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFIFO, stat.S_IFSOCK, stat.S_IFDIR):
        yield f"a file of the kind {kind:o}", packed(files, change=altered(chunk, external_attr=(kind | 0o777) << 16))
    yield "encrypted", patched(raw, 6, 1)
    yield from ((f"said to be compressed by method {k}", patched(raw, 8, k)) for k in (1, 8, 9, 12, 14, 93, 99))
    yield "compressed", packed(files, zipfile.ZIP_DEFLATED)
    yield "a bomb", packed(files | {chunk: bytes(2**25)}, zipfile.ZIP_DEFLATED)
    for size in (2**40, 2**31, len(raw) + 1, len(files[chunk]) + 1, 0):
        yield f"a size of {size}", packed(files, change=altered(chunk, file_size=size, compress_size=size))
    yield "two sizes", packed(files, change=altered(chunk, file_size=len(files[chunk]) + 8))
    yield "files that overlap", packed(files, change=altered(chunk, header_offset=0))
    for offset in (len(raw), 2**40):
        yield f"a place at {offset}", packed(files, change=altered(chunk, header_offset=offset))
    yield "a wrong checksum", packed(files, change=altered(chunk, CRC=7))
    yield "a description of 10⁵ brackets", packed(files | {"q/zarr.json": b"[" * 100_000})
    yield "a root of 10⁵ brackets", packed(files | {"zarr.json": b"[" * 100_000})
    yield "arrays of NumPy", packed({"q.npy": b"\x93NUMPY"})
    yield "empty zip file", b"PK\x05\x06" + bytes(18)
    yield "a directory at 2⁶³", b"PK\x05\x06" + bytes(8) + b"\xff" * 8 + bytes(2)
    yield "no bytes", b""
    yield "text", b"no archive"
    yield "a picture", b"\x89PNG\r\n\x1a\n" + bytes(100)


def one_line(capsys, *arguments, what=""):
    """Assert that a command ends with exit code 2 and one line on stderr; the line."""
    assert cli.main([str(x) for x in arguments]) == 2, (arguments, what)
    error = capsys.readouterr().err
    assert error.startswith("lieint: "), (arguments, what)
    assert error.count("\n") == 1, error
    return error


def grown(before):
    """The memory that this process holds at most beyond that of before, in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before


@pytest.fixture
def bounded():
    before = grown(0)
    yield
    assert grown(before) < _MEMORY


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A complete store of two bodies."""
    path = tmp_path_factory.mktemp("good") / "run.zarr"
    run_into(path)
    return path


def run_into(path, **options):
    states = jax.jit(jax.vmap(lambda w: BODY.state(angular_velocity=w)))(np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8]]))
    li.run(li.schemes.so3_midpoint(BODY), states, 0.05, 4, save_every=2, store=path, progress=False, **options)


@pytest.mark.usefixtures("bounded")
def test_altered_zip_files_are_refused_with_a_sentence(good, tmp_path, capsys):
    cases = list(zips(good))
    assert len(cases) > 100
    path = tmp_path / "run.zip"
    for k, (what, raw) in enumerate(cases):
        path.write_bytes(raw)
        with pytest.raises((ValueError, OSError), match=r"run\.zip") as refused:
            li.open(path)
        assert "\n" not in str(refused.value), what
        if k % 20 == 0:
            one_line(capsys, "info", path, what=what)
    assert os.listdir(tmp_path) == ["run.zip"]


@pytest.mark.long
@pytest.mark.usefixtures("bounded")
def test_a_zip_file_with_any_one_byte_altered_is_refused_or_the_same_run(good, tmp_path):
    raw, path, rng, refused = packed(files_of(good)), tmp_path / "run.zip", np.random.default_rng(5), 0
    path.write_bytes(raw)
    expected = li.open(path).load()
    for _ in range(300):
        altered = bytearray(raw)
        altered[int(rng.integers(len(raw)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(altered)
        try:
            found = li.open(path).load()
        except (ValueError, OSError):
            refused += 1
        else:  # a date, or a mode
            for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
                np.testing.assert_array_equal(x, y)
    assert refused > 200


def rooted(change):
    """A change of a store: `change` is of its root's metadata, whose checksum is then right again."""

    def apply(path):
        file = path / "zarr.json"
        root = json.loads(file.read_text())
        root = change(root, root["attributes"], root["consolidated_metadata"]["metadata"]) or root
        write_root(file, root)

    return apply


def put(*keys, value):
    """A change that puts a value at these keys of the attributes; `del` it if it is ..."""

    def change(_, attributes, shown):
        *above, last = keys
        for key in above:
            attributes = shown if key == "shown" else attributes[key]
        if value is ...:
            del attributes[last]
        else:
            attributes[last] = value

    return rooted(change)


def many_chunks(_, attributes, shown):
    """The time of 10¹² entries in chunks of one, of which none is published."""
    attributes["num_entries"], attributes["progress"]["entries"] = 10**12, 0
    for meta in shown.values():
        if meta.get("dimension_names", [""])[:1] == ["time"]:
            meta["shape"][0] = 0
    shown["time"]["chunk_grid"]["configuration"]["chunk_shape"] = [1]


def in_place_of(name, make):
    """A change that puts something else in the place of a file or folder."""

    def change(path):
        file = path / name
        shutil.rmtree(file) if file.is_dir() else file.unlink()
        make(file)

    return change


def stores(good):
    """Changes of a store, by what they do."""
    [constant] = json.loads((good / "zarr.json").read_text())["attributes"]["constants"]
    constant = f"step/{constant}"
    required = ("progress", "run", "members", "num_steps", "save_every", "dt", "reduce", "scheme", "system", "format")
    required += ("batch", "per", "leaves", "constants", "description", "time_unit", "num_entries", "digests")
    required += ("member_chunk", "time_chunk")
    yield from ((f"without {key}", put(key, value=...)) for key in required)
    others = {"members": ["2", 0, -1, True, 3, 10**30], "progress": [[], {}, {"entries": 3}], "dt": ["fast", [], {}]}
    others |= {"save_every": [0, "2"], "run": [[], {}, 5], "leaves": [5, ["../q", "p"], [["q"]], ["q", "p", "x"]]}
    others |= {"constants": [["../../../etc"], ["/etc"], [".."], [5], "q", ["nothing"], {}], "reduce": [3, "energy"]}
    others |= {"format": ["2", 5, 99], "scheme": [5], "system": [None], "num_steps": ["many"], "num_entries": [-1, "3"]}
    for key, values in others.items():
        yield from ((f"{key} = {value!r}", put(key, value=value)) for value in values)
    for key, value in (("entries", 4), ("entries", "3"), ("entries", -3), ("complete", 1), ("commits", 0.5)):
        yield f"progress of {key} = {value!r}", put("progress", key, value=value)
    for key, value in (("versions", []), ("versions", {"jax": 3}), ("own_step", 0), ("own_step", "0"), ("device", 1)):
        yield f"run of {key} = {value!r}", put("run", key, value=value)
    nested = {"tuple": []}
    for _ in range(200):
        nested = {"tuple": [nested]}
    systems = [nested, {}, [], 3, {"nonsense": 3}, {"name": "lieint_jax.systems"}, {"array": "q"}]
    systems += [{"class": "lieint_jax.systems.RigidBody", "fields": x} for x in ({}, [], {"inertia": 3})]
    systems += [{"class": "lieint_jax.systems.RigidBody"}, {"class": 3}, {"group": "SO(3)", "fields": {}}]
    yield from ((f"system {str(x)[:60]}", put("description", "system", value=x)) for x in systems)
    forged = (("shape", [10**12] * 2), ("shape", "3"), ("shape", [-1]), ("shape", [True]), ("data_type", "complex128"))
    forged += (("data_type", "object"), ("fill_value", 3), ("dimension_names", ["x"] * 9))
    for name in ("q", "p", "time", "residual", "converged", constant):
        yield f"no array {name}", put("shown", name, value=...)
        for key, value in forged:
            yield f"{name} of {key} {value}", put("shown", name, key, value=value)
        yield f"{name} is 3", put("shown", name, value=3)
        yield f"{name} has no chunks", put("shown", name, "chunk_grid", value={})
        yield f"{name} has chunks of 0", put("shown", name, "chunk_grid", "configuration", "chunk_shape", value=[0])
        yield f"codecs of {name}", put("shown", name, "codecs", value=[])
    yield "an array out of the store", put("shown", "../../x", value={})
    yield "an array of the step out of the store", put("shown", "step/../../x", value={})
    yield "no group of the step", put("shown", "step", value=...)
    yield "a group of the step with attributes", put("shown", "step", "attributes", value={"x": 1})
    yield "no consolidated metadata", rooted(lambda root, *_: root.pop("consolidated_metadata") and None)
    yield "attributes are a list", rooted(lambda root, *_: root | {"attributes": []})
    for text in ("", "{", "[]", "3", "[" * 100_000, "\xff", '{"attributes": {}}', '{"attributes": {"progress": 1}}'):
        yield f"root {text[:20]!r}", in_place_of("zarr.json", lambda file, text=text: file.write_text(text, "latin-1"))
    for name in ("zarr.json", "q/zarr.json", "step/zarr.json", "q/c/0/0/0", f"{constant}/c/0"):
        yield f"no {name}", in_place_of(name, lambda _: None)
        yield f"{name} is a pipe", in_place_of(name, os.mkfifo)
        yield f"{name} is a device", in_place_of(name, lambda file: file.symlink_to("/dev/zero"))
        yield f"{name} is a link to nothing", in_place_of(name, lambda file: file.symlink_to("nowhere"))
        yield f"{name} is a folder", in_place_of(name, os.mkdir)
        yield f"{name} is empty", in_place_of(name, Path.touch)
    for text in ("[]", "{}", "3", '{"shape": 3}', '{"shape": [1000000000000]}'):
        yield f"q is described as {text}", in_place_of("q/zarr.json", lambda file, text=text: file.write_text(text))
    yield "no folder q", in_place_of("q", lambda _: None)
    yield "q/c is a link to a folder", in_place_of("q/c", lambda file: file.symlink_to("/dev/fd"))
    yield "a constant of many chunks", rooted(many_chunks)
    yield "a name with a control character", rooted(lambda root, _, shown: shown.update({"a\n\x1b[31mb": shown["q"]}))


@pytest.mark.long
@pytest.mark.parametrize("part", range(4))
@pytest.mark.usefixtures("bounded")
def test_altered_stores_are_refused_with_a_sentence(part, good, tmp_path, capsys):
    cases = list(stores(good))
    assert len(cases) > 100
    path = tmp_path / "run.zarr"
    for k, (what, change) in enumerate(cases[part::4]):
        shutil.copytree(good, path)
        change(path)
        for command in ("info", "plot", "animate") if k % 8 == 0 else ("info",):
            one_line(capsys, command, path, what=what)
        with pytest.raises((ValueError, OSError)):
            li.open(path)
        if k % 8 == 2:
            (tmp_path / "run.zip").write_bytes(packed(files_of(path)))
            for command in ("plot", "animate"):
                one_line(capsys, command, tmp_path / "run.zip", what=what)
            with pytest.raises((ValueError, OSError)):
                li.open(tmp_path / "run.zip")
        if k % 8 == 1 and "system" not in what:  # which a run that resumes has of its own
            with pytest.raises((ValueError, OSError)):
                run_into(path, resume=True)
        shutil.rmtree(path)


def places(tmp_path):
    """Paths of what is no file of results, by what they are."""
    pipe, loop, link = (tmp_path / f"{name}.zip" for name in ("pipe", "loop", "link"))
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    link.symlink_to("nowhere")
    (tmp_path / "folder.zip").mkdir()
    (tmp_path / "file.zarr").write_text("")
    (tmp_path / "empty.zarr").mkdir()
    yield from (pipe, loop, link, "/dev/zero", "/dev/null", "/dev/stdin", tmp_path, "nowhere.zip", "nowhere.zarr", "")
    yield from (tmp_path / name for name in ("folder.zip", "file.zarr", "empty.zarr"))
    yield from ("a" * 5000, "a" * 5000 + ".zip", "a" * 5000 + ".zarr", "null\0.zip", "null\0.zarr", "two\nlines.zip")


def test_files_without_results_are_refused_with_a_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for path in list(places(tmp_path)):
        for command in ("info", "plot", "animate"):
            error = one_line(capsys, command, path)
            assert len(error) < 500
