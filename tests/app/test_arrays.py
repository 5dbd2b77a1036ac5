"""The files of the page on job arrays: those that can run here run as written, the others parse."""

import json
import os
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import scenario_files
from documents import blocks

from lieint_jax import ensemble
from lieint_jax.app.command import cli, info

PAGE = (Path(__file__).parents[2] / "docs/pages/howto/arrays.md").read_text(encoding="utf-8")


def code(language, mark):
    [found] = [code for _, code in blocks(PAGE, language) if mark in code]
    return found


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my.toml").write_text(scenario_files.book())
    return tmp_path


def environment(**variables):
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return os.environ | {"PATH": paths, "PYTHONPATH": os.pathsep.join(sys.path)} | variables


@pytest.mark.long
def test_the_slurm_script_runs_with_the_variables_of_slurm(folder):
    Path("job.sh").write_text(code("bash", "#SBATCH"))
    for k in (3, 0, 2, 1):
        array = dict(SLURM_ARRAY_TASK_ID=str(k), SLURM_ARRAY_TASK_MIN="0", SLURM_ARRAY_TASK_COUNT="4")
        subprocess.run(["bash", "job.sh"], env=environment(**array), check=True)
    assert "4 of 4 part(s) complete" in info.contents(folder / "run.zarr")


def test_the_commands_of_gnu_parallel_parse():
    words = shlex.split(code("bash", "parallel"))
    options, values = words[words.index("lieint") + 1 : words.index(":::")], words[words.index(":::") + 1 :]
    assert values == [str(k) for k in range(8)]
    for k in values:
        parsed = cli._parser().parse_args([word.replace("{}", k) for word in options])
        assert ensemble.part_of_text(parsed.part) == (int(k), 8)


def test_the_command_of_kubernetes_parses():
    yaml = pytest.importorskip("yaml")
    job = yaml.safe_load(code("yaml", "Indexed"))["spec"]
    [container] = job["template"]["spec"]["containers"]
    parsed = cli._parser().parse_args([*container["command"][1:], *container["args"]])
    assert parsed.part == f"auto/{job['completions']}"
    assert parsed.out == "s3://bucket/run.zarr"


def test_the_command_of_aws_batch_parses():
    command = json.loads(code("json", "jobDefinitionName"))["containerProperties"]["command"]
    parsed = cli._parser().parse_args(command[1:])
    assert (parsed.part, parsed.out) == ("auto", "s3://bucket/run.zarr")


@pytest.mark.long
@pytest.mark.skipif(find_spec("distributed") is None, reason="needs Dask: pip install distributed")
def test_the_parts_run_on_a_dask_cluster(folder):
    Path("dask_parts.py").write_text(code("py", "distributed"))
    command = [sys.executable, "dask_parts.py"]
    found = subprocess.run(command, env=environment(), check=True, capture_output=True, text=True)
    assert "complete: [0, 1, 2, 3]" in found.stdout
    run, _ = ensemble.open(folder / "dask.zarr")
    assert run.state.q.shape == (5, 100, 4)
    assert run.info.converged[...].all()
