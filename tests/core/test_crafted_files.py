"""Files of results that are damaged or crafted: every command that reads them answers with one line and exit code 2."""

import functools
import io
import itertools
import json
import os
import resource
import shutil
import struct
import tempfile
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest
from internals import write_root
from scenario_files import book

import lieint_jax as li
from lieint_jax.app import scenarios
from lieint_jax.app.command import cli
from lieint_jax.runs import store

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
_MEMORY = 300e6  # bytes, the most that all the cases of a test may add: one that is believed asks for more


@functools.cache
def arrays():
    """The arrays of an archive of two bodies with eleven entries."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "book.toml")
        file.write_text(book(members="members = 2", steps="steps = 1600", save_every="save_every = 160"))
        scenario = scenarios.load(str(file))
        run = li.run(*scenario.build(), **scenario.clock(), save_every=scenario.save_every)
        described = {"scenario": scenario.model_dump(), "lieint_jax": "0.5", "jax": "0.12"}
        store.write_trajectory(Path(folder, "run.npz"), run.trajectory, described)
        with np.load(Path(folder, "run.npz")) as found:
            return dict(found)


def packed(changed=(), method=zipfile.ZIP_STORED, name="{}.npy"):
    """The bytes of an archive of a valid run with other arrays, bytes in place of arrays, or None for none."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for key, x in (arrays() | dict(changed)).items():
            if isinstance(x, np.ndarray):
                x, array = io.BytesIO(), x
                np.lib.format.write_array(x, array)
                x = x.getvalue()
            if x is not None:
                archive.writestr(name.format(key), x)
    return stream.getvalue()


def header(text, data=b"", version=(1, 0)):
    """An .npy with this header."""
    size = struct.pack("<H" if version[0] == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes(version) + size + text.encode() + data


def of_shape(shape, kind="<f8"):
    return header(f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}}}", bytes(64))


def described(**changes):
    """The metadata of the run with these changes to the keys of its scenario."""
    found = json.loads(str(arrays()["metadata"]))
    found["scenario"] |= changes
    return {"metadata": np.array(json.dumps(found))}


def patched(raw, offset, value):
    """`raw` with two bytes at an offset behind the mark of every header of an array, local and central."""
    found = bytearray(raw)
    for mark, shift in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        at = found.find(mark)
        while at >= 0:
            struct.pack_into("<H", found, at + shift + offset, value)
            at = found.find(mark, at + 4)
    return bytes(found)


def archives():
    """The bytes of crafted archives, by what is wrong with them."""
    good, x = packed(), arrays()
    yield from ((f"cut at {k}/8", good[: len(good) * k // 8]) for k in range(8))
    yield from ((f"without {name}", packed({name: None})) for name in x)
    for name, kind in itertools.product(("t", "q", "p", "residual"), ("c16", ">f8", "f2", "i8", "U4", "S3", "M8[s]")):
        yield f"{name} as {kind}", packed({name: x[name].astype(np.int64 if kind[0] == "M" else kind).astype(kind)})
    yield "converged as f8", packed({"converged": x["converged"].astype(float)})
    yield "Python objects", packed({"p": None}) and packed({"p": of_shape((1,), "|O")})
    yield "records", packed({"t": np.zeros(11, [("a", float)])})
    for name in ("t", "q", "p", "residual", "converged"):
        yield f"{name} too short", packed({name: x[name][:3]})
        yield f"{name} has one axis more", packed({name: x[name][:, None]})
        yield f"{name} is a number", packed({name: np.asarray(x[name].reshape(-1)[0])})
        yield f"{name} is empty", packed({name: x[name][:0]})
    yield "q of five components", packed({"q": np.ones((11, 2, 5))})
    yield "p of two components", packed({"p": np.ones((11, 2, 2))})
    yield "q off the group", packed({"q": 3 * x["q"]})
    yield "t is not finite", packed({"t": np.where(x["t"] > 1, np.nan, x["t"])})
    yield "t goes back", packed({"t": x["t"] * (-1) ** np.arange(11)})
    yield "three members of two", packed({"p": np.ones((11, 3, 3))})
    yield "a time for each of three members", packed({"state.t": np.zeros((11, 3))})
    yield "work of another shape", packed({"work": np.zeros(11)})
    for shape in ("(10**12, 2, 4)", "(1000000000000, 2, 4)", "(-1, 2, 4)", "('a',)", "3.5", "(True,)", "(11, 2, 99)"):
        yield f"header of shape {shape}", packed({"q": of_shape(shape)})
    yield "header is no table", packed({"q": header("[]")})
    yield "header is no Python", packed({"q": header("}{")})
    yield "header of nested brackets", packed({"q": header("(" * 9000)})
    yield "long header", packed({"q": header(" " * 60000)})
    yield "longer header than the file", packed({"q": header("", version=(2, 0))[:-4] + b"\xff\xff\xff\x7f"})
    yield "header of version 9", packed({"q": header("{}", version=(9, 9))})
    yield "no header", packed({"q": b"q"})
    tables = ['{"scenario": 3}', '{"scenario": []}', '{"lieint_jax": 3}']
    for text in ("", "{", "[]", "3", "null", '"text"', *tables, "\\"):
        yield f"metadata {text!r}", packed({"metadata": np.array(text)})
    yield "nested metadata", packed({"metadata": np.array("[" * 100_000)})
    yield "deeply nested metadata", packed({"metadata": np.array('{"scenario": ' + "[" * 500 + "]" * 500 + "}")})
    yield "metadata of numbers", packed({"metadata": np.zeros(3)})
    yield "huge metadata", packed({"metadata": header("{'descr': '<U999999999', 'fortran_order': False, 'shape': ()}")})
    for key, value in (("members", 3), ("members", "2"), ("steps", 10**12), ("steps", True), ("save_every", 0)):
        yield f"{key} = {value!r}", packed(described(**{key: value}))
    yield "save_at is no list", packed(described(save_at=7))
    for name in ("../{}.npy", "/{}.npy", "a/{}.npy", "{}", "..\\{}.npy"):
        yield f"names {name}", packed(name=name)
    yield "encrypted", patched(good, 6, 1)
    yield from ((f"compressed by method {k}", patched(good, 8, k)) for k in (1, 9, 12, 14, 93, 99))
    yield "a bomb", packed({"q": bytes(2**25)}, zipfile.ZIP_DEFLATED)
    yield "a bomb with a header", packed({"q": of_shape("(2097152, 2, 1)")[:-64] + bytes(2**25)}, zipfile.ZIP_DEFLATED)
    yield "damaged inside", good[:700] + bytes(32) + good[732:]
    yield "empty archive", b"PK\x05\x06" + bytes(18)
    yield "text", b"no archive"
    yield "a picture", b"\x89PNG\r\n\x1a\n" + bytes(100)
    yield "a study without a name", packed({"metadata": np.array('{"tree": {}}')})
    names = {"study": "gyro", "quick": True, "lieint_jax": "9", "jax": "9"}
    for tree in (3, {"type": "os:system", "fields": {}}, {"array": "nothing"}, {"tuple": 3}, {}, {"dict": [[[], 1]]}):
        yield f"tree {tree}", packed({"metadata": np.array(json.dumps(names | {"study": "gyro", "tree": tree}))})


def one_line(capsys, *arguments):
    """Assert that a command ends with exit code 2 and one line on stderr; the line."""
    assert cli.main([str(x) for x in arguments]) == 2, arguments
    error = capsys.readouterr().err
    assert error.startswith("lieint: "), arguments
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


def test_the_unaltered_run_is_read(tmp_path):
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # np.savez and np.savez_compressed
        (tmp_path / "run.npz").write_bytes(packed(method=method))
        assert store.load_results(tmp_path / "run.npz")[0].state.q.shape == (11, 2, 4)


@pytest.mark.long
@pytest.mark.usefixtures("bounded")
def test_altered_archives_are_refused_with_a_sentence(tmp_path, capsys):
    cases = list(archives())
    assert len(cases) > 100
    path = tmp_path / "run.npz"
    for k, (what, raw) in enumerate(cases):
        path.write_bytes(raw)
        study = what.startswith("tree")
        for command in ("plot",) if study else ("info", "plot", "animate") if k % 8 == 0 else ("info",):
            one_line(capsys, command, path)
    assert os.listdir(tmp_path) == ["run.npz"]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A complete store of two bodies."""
    path = tmp_path_factory.mktemp("good") / "run.zarr"
    run_into(path)
    return path


def run_into(path, **options):
    states = jax.jit(jax.vmap(lambda w: BODY.state(angular_velocity=w)))(np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8]]))
    li.run(li.schemes.so3_midpoint(BODY), states, 0.05, 4, save_every=2, store=path, progress=False, **options)


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
    for key, value in (("versions", []), ("versions", {"jax": 3}), ("step_axis", 0), ("step_axis", "0"), ("device", 1)):
        yield f"run of {key} = {value!r}", put("run", key, value=value)
    nested = {"tuple": []}
    for _ in range(200):
        nested = {"tuple": [nested]}
    systems = [nested, {}, [], 3, {"nonsense": 3}, {"name": "lieint_jax.systems"}, {"array": "q"}]
    systems += [{"class": "lieint_jax.systems.RigidBody", "fields": x} for x in ({}, [], {"inertia": 3})]
    systems += [{"class": "lieint_jax.systems.RigidBody"}, {"class": 3}, {"group": "SO(3)", "fields": {}}]
    yield from ((f"system {str(x)[:60]}", put("description", "system", value=x)) for x in systems)
    for name in ("q", "p", "time", "residual", "converged", constant):
        yield f"no array {name}", put("shown", name, value=...)
        for key, value in (("shape", [10**12] * 2), ("shape", "3"), ("shape", [-1]), ("data_type", "complex128")):
            yield f"{name} of {key} {value}", put("shown", name, key, value=value)
        yield f"{name} is 3", put("shown", name, value=3)
        yield f"{name} has no chunks", put("shown", name, "chunk_grid", value={})
        yield f"{name} has chunks of 0", put("shown", name, "chunk_grid", "configuration", "chunk_shape", value=[0])
        yield f"codecs of {name}", put("shown", name, "codecs", value=[])
    yield "an array out of the store", put("shown", "../../x", value={})
    yield "no consolidated metadata", rooted(lambda root, *_: root.pop("consolidated_metadata") and None)
    yield "attributes are a list", rooted(lambda root, *_: root | {"attributes": []})
    for text in ("", "{", "[]", "3", "[" * 100_000, "\xff", '{"attributes": {}}', '{"attributes": {"progress": 1}}'):
        yield f"root {text[:20]!r}", in_place_of("zarr.json", lambda file, text=text: file.write_text(text, "latin-1"))
    for name in ("zarr.json", "q/zarr.json", "q/c/0/0/0", f"{constant}/c/0"):
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
            one_line(capsys, command, path)
        with pytest.raises((ValueError, OSError)):
            li.open(path)
        if k % 8 == 1 and "system" not in what:  # which a run that resumes has of its own
            with pytest.raises((ValueError, OSError)):
                run_into(path, resume=True)
        shutil.rmtree(path)


def places(tmp_path):
    """Paths of what is no file of results, by what they are."""
    pipe, loop, link = (tmp_path / f"{name}.npz" for name in ("pipe", "loop", "link"))
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    link.symlink_to("nowhere")
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "file.zarr").write_text("")
    (tmp_path / "empty.zarr").mkdir()
    yield from (pipe, loop, link, "/dev/zero", "/dev/null", "/dev/stdin", tmp_path, "nowhere.npz", "nowhere.zarr", "")
    yield from (tmp_path / name for name in ("folder.npz", "file.zarr", "empty.zarr"))
    yield from ("a" * 5000, "a" * 5000 + ".npz", "a" * 5000 + ".zarr", "null\0.npz", "null\0.zarr", "two\nlines.npz")


def test_files_without_results_are_refused_with_a_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for path in list(places(tmp_path)):
        for command in ("info", "plot", "animate"):
            error = one_line(capsys, command, path)
            assert len(error) < 500
