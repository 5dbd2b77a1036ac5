"""The page on clusters: its script runs as an array of jobs, and under the commands of its files, as written."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from documents import blocks
from stores import assert_same

import lieint_jax as li

PAGE = (Path(__file__).parents[2] / "docs/pages/howto/clusters.md").read_text(encoding="utf-8")
pytestmark = pytest.mark.usefixtures("fresh_folder")


def code(language, mark):
    """The one block of the page in a language that has this text."""
    [found] = [code for _, code in blocks(PAGE, language) if mark in code]
    return found


def environment(**variables):
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return os.environ | {"PATH": paths, "PYTHONPATH": os.pathsep.join(sys.path)} | variables


SBATCH = """
import os, pathlib, re, subprocess, sys, time
last = int(re.search(r"--array=0-(\\d+) ", pathlib.Path("array.sbatch").read_text())[1])
array = os.environ | dict(SLURM_ARRAY_TASK_MIN="0", SLURM_ARRAY_TASK_COUNT=str(last + 1), SLURM_CPUS_PER_TASK="1")
for k in range(last + 1):
    task = dict(args=["bash", "array.sbatch"], env=array | {"SLURM_ARRAY_TASK_ID": str(k)}, stdout=subprocess.DEVNULL)
    if k == 1:  # is preempted, and put back into the queue
        with subprocess.Popen(**task) as first:
            while not os.path.exists("run.zarr/parts/1"):
                assert first.poll() is None
                time.sleep(0.005)
            first.kill()
        assert not os.path.exists("run.zarr/parts/1/state") or first.returncode == -9
    subprocess.run(**task, check=True)
"""


@pytest.mark.long
def test_an_array_of_slurm_is_one_run(lieint):
    script = code("py", 'part="auto"')
    Path("parts.py").write_text(script)
    Path("array.sbatch").write_text(code("bash", "#SBATCH"))
    subprocess.run([sys.executable, "-c", SBATCH], env=environment(), check=True)
    assert "8 of 8 part(s) complete" in lieint("info", "run.zarr")
    Path("whole.py").write_text(script.replace(', part="auto"', "").replace("run.zarr", "whole.zarr"))
    subprocess.run([sys.executable, "whole.py"], env=environment(), check=True)
    assert_same(li.open("run.zarr").state, li.open("whole.zarr").state)


def kubernetes():
    """The command of the page's job, the line of its script, and the variables of task 3."""
    yaml = pytest.importorskip("yaml")
    job = yaml.safe_load(code("yaml", "Indexed"))["spec"]
    [container] = job["template"]["spec"]["containers"]
    [part] = {x for x in (f"li.part_of_task({job['completions']})",) if x in PAGE}
    return container["command"] + container.get("args", []), part, {"JOB_COMPLETION_INDEX": "3"}


def aws_batch():
    command = json.loads(code("json", "jobDefinitionName"))["containerProperties"]["command"]
    return command, '"auto"', {"AWS_BATCH_JOB_ARRAY_INDEX": "3", "AWS_BATCH_JOB_ARRAY_SIZE": "8"}


@pytest.mark.skipif(find_spec("obstore") is None, reason="needs obstore: pip install lieint_jax[cloud]")
@pytest.mark.parametrize("scheduler", [kubernetes, aws_batch])
def test_the_command_of_a_job_runs_the_part_of_its_task(scheduler, tmp_path, monkeypatch, lieint):
    words, part, variables = scheduler()
    name, bucket = f"parts_of_{scheduler.__name__}.py", f"memory://tests{tmp_path}"
    Path(name).write_text(code("py", 'part="auto"').replace('"auto"', part))
    words = [word.replace("/scripts/parts.py", name).replace("s3://bucket", bucket) for word in words]
    assert words[0] == "lieint"
    for key, value in variables.items():
        monkeypatch.setenv(key, value)
    lieint(*words[1:], "--members", "16")
    with pytest.warns(RuntimeWarning, match=r"part 0 \(members 0 … 1\) is missing"):
        found = li.open(f"{bucket}/run.zarr")
    assert found.info.converged[:].all(axis=0).tolist() == [False] * 6 + [True] * 2 + [False] * 8


@pytest.mark.long
def test_the_script_of_dask_runs_on_a_cluster():
    pytest.importorskip("distributed")
    Path("dask_parts.py").write_text(code("py", "distributed"))
    subprocess.run([sys.executable, "dask_parts.py"], env=environment(), check=True)
    assert li.open("dask.zarr").state.q.shape == (5, 100, 4)
