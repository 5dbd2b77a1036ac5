"""The page on clusters: its scripts run as written, with the variables of schedulers, and its files name them."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from documents import blocks
from stores import assert_same

import lieint_jax as li
from lieint_jax.command import cli

PAGE = (Path(__file__).parents[2] / "docs/pages/howto/clusters.md").read_text(encoding="utf-8")
SLURM = {"SLURM_ARRAY_TASK_MIN": "0", "SLURM_ARRAY_TASK_COUNT": "3", "SLURM_CPUS_PER_TASK": "1"}
BATCH = {"AWS_BATCH_JOB_ARRAY_SIZE": "3"}


def code(language, mark):
    [found] = [code for _, code in blocks(PAGE, language) if mark in code]
    return found


@pytest.fixture
def script(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("parts.py").write_text(code("py", "def main("), encoding="utf-8")
    return tmp_path


def started(*words, **variables):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | variables
    return subprocess.Popen([sys.executable, *words], env=environment, stdout=subprocess.DEVNULL)


@pytest.mark.long
def test_an_array_of_jobs_runs_the_script_and_a_killed_task_continues(script):
    """Tasks 0 and 2 end; task 1 is killed when it begins to write, and put back into the queue."""
    command = ["-m", "lieint_jax.command.cli", "run", "parts.py", "--members", "3000"]
    for task in "02":
        assert started(*command, **SLURM, SLURM_ARRAY_TASK_ID=task).wait() == 0
    with started(*command, **SLURM, SLURM_ARRAY_TASK_ID="1") as lost:
        while not Path("run.zarr/parts/1").exists():
            assert lost.poll() is None
            time.sleep(0.002)
        lost.kill()
    assert lost.returncode == -9
    assert started(*command, **SLURM, SLURM_ARRAY_TASK_ID="1").wait() == 0
    whole = Path("whole.py")
    whole.write_text(code("py", "def main(").replace(', part="auto"', ""), encoding="utf-8")
    assert started("-m", "lieint_jax.command.cli", "run", str(whole), *command[4:], "--store", "whole.zarr").wait() == 0
    assert_same(li.open("run.zarr").state, li.open("whole.zarr").state)


@pytest.mark.long
def test_the_script_runs_by_itself_in_the_array_of_the_page(script):
    """`exec python parts.py`, with the numbers of the page, of which one part of 800 is computed here."""
    assert code("bash", "#SBATCH").splitlines()[-1] == "exec python parts.py"
    assert started("parts.py", **SLURM | {"SLURM_ARRAY_TASK_COUNT": "800"}, SLURM_ARRAY_TASK_ID="0").wait() == 0
    with pytest.warns(RuntimeWarning, match="parts? "):
        run = li.open("run.zarr")
    assert run.state.q.shape == (11, 100_000, 4)


def test_the_commands_of_kubernetes_and_aws_batch_are_those_of_the_script(script):
    yaml = pytest.importorskip("yaml")
    [container] = yaml.safe_load(code("yaml", "Indexed"))["spec"]["template"]["spec"]["containers"]
    batch = json.loads(code("json", "jobDefinitionName"))["containerProperties"]["command"]
    assert batch == container["command"]
    scope = {"__name__": "page"}
    exec(code("py", "def main("), scope)
    assert batch[:3] == ["lieint", "run", "/scripts/parts.py"]
    call = cli._options(scope["main"], "lieint run parts.py", batch[3:])
    assert call.keywords["store"] == "s3://bucket/run.zarr"


@pytest.mark.parametrize("variables", [BATCH | {"AWS_BATCH_JOB_ARRAY_INDEX": "1"}, {"JOB_COMPLETION_INDEX": "1"}])
def test_the_part_of_a_task_is_found_as_the_page_says(variables, monkeypatch):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert li.part_of_task(3) == (1, 3)
    if "JOB_COMPLETION_INDEX" in variables:
        with pytest.raises(ValueError, match="Kubernetes does not report the number of tasks"):
            li.part_of_task()


@pytest.mark.long
def test_the_script_of_dask_runs_as_written(script):
    pytest.importorskip("distributed")
    Path("dask_parts.py").write_text(code("py", "distributed"), encoding="utf-8")
    assert started("dask_parts.py").wait() == 0
    run = li.open("dask.zarr")
    assert run.state.q.shape == (5, 100, 4)
    assert bool(run.converged[...].all())
