"""The page on clusters: its files run as written where they can run here, the others parse; `lieint run --parts`."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import scenario_files
from documents import blocks
from stores import assert_same

import lieint_jax as li
from lieint_jax.app.command import cli, info, run
from lieint_jax.runs import part_of_text

PAGE = (Path(__file__).parents[2] / "docs/pages/howto/clusters.md").read_text(encoding="utf-8")


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


SBATCH = """#!{python}
import os, pathlib, re, subprocess, sys, time
script = sys.argv[-1]
last = int(re.search(r"--array=0-(\\d+) ", pathlib.Path(script).read_text())[1])
array = dict(os.environ, SLURM_ARRAY_TASK_MIN="0", SLURM_ARRAY_TASK_COUNT=str(last + 1), SLURM_CPUS_PER_TASK="1")
for k in range(last + 1):
    command = dict(args=["bash", script], env=array | {{"SLURM_ARRAY_TASK_ID": str(k)}}, stdout=subprocess.DEVNULL)
    if k == 1:  # is preempted, and put back into the queue
        with subprocess.Popen(**command) as task:
            while not os.path.exists("run.zarr/parts/1"):
                assert task.poll() is None
                time.sleep(0.005)
            task.kill()
        assert not os.path.exists("run.zarr/parts/1/state") or task.returncode == -9
    subprocess.run(**command, check=True)
print("4711")
"""


@pytest.mark.long
def test_an_array_of_slurm_is_written_submitted_and_one_run(folder, monkeypatch, lieint):
    sbatch = folder / "bin" / "sbatch"
    sbatch.parent.mkdir()
    sbatch.write_text(SBATCH.format(python=sys.executable))
    sbatch.chmod(0o755)
    for name, value in environment(PATH=f"{sbatch.parent}{os.pathsep}{os.environ['PATH']}").items():
        monkeypatch.setenv(name, value)
    options = ["--time=4:00:00 --cpus-per-task=4", "--members", "9", "--set", "dt=0.05"]
    assert "run.sbatch is job 4711" in lieint(
        "run", "my.toml", "--out", "run.zarr", "--parts", "3", "--slurm", *options
    )
    assert "3 of 3 part(s) complete" in info.contents(folder / "run.zarr")
    run.run("my.toml", Path("whole.zarr"), 9, given=["dt=0.05"])
    assert_same(li.open("run.zarr").state, li.open("whole.zarr").state)


def test_the_script_of_the_page_is_the_one_that_is_written(folder, monkeypatch, lieint):
    monkeypatch.setenv("PATH", str(folder))
    [command] = [line for line in code("sh", "--slurm").splitlines() if "--slurm" in line]
    assert "there is no sbatch on this machine: submit run.sbatch" in lieint.refuse(*shlex.split(command)[1:])
    assert Path("run.sbatch").read_text().replace(sys.executable, "python") == code("bash", "#SBATCH")
    (folder / "sbatch").write_text("#!/bin/sh\necho no such partition >&2; exit 1\n")
    (folder / "sbatch").chmod(0o755)
    assert "sbatch refuses run.sbatch: no such partition" in lieint.refuse(*shlex.split(command)[1:])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--parts 8 --out x.zarr", "--parts needs one of --dask ADDRESS and --slurm OPTIONS"),
        ("--dask localhost:1", "--dask runs a scenario in parts: give their number"),
        ("--parts 8 --dask localhost:1 --out x.npz", "--parts needs --out NAME.zarr"),
        ("--parts 8 --dask localhost:1 --out x.zarr --part 0/8", "--parts starts every part itself"),
        ("--parts 8 --slurm= --out x.zarr --set scheme=none", "scheme"),
        ("--parts 8 --slurm= --out x.zarr --export x.csv", "--export writes the whole run"),
    ],
)
def test_options_that_do_not_fit_are_refused(folder, lieint, options, message):
    assert message in lieint.refuse("run", "my.toml", *options.split())
    assert [path.name for path in folder.iterdir()] == ["my.toml"]


def test_a_kind_in_a_file_that_workers_do_not_have_is_refused(folder, lieint):
    text = "from lieint_jax.app.scenarios.rigid_body import FreeBody\n\nclass Mine(FreeBody):\n    'Mine.'\n"
    Path("mine.py").write_text(text)
    command = "run my.toml --set system=mine.py:Mine --out x.zarr --parts 2 --dask localhost:1"
    assert "the workers of Dask do not have the file of mine.py:Mine: use --slurm" in lieint.refuse(*command.split())


def test_the_commands_of_gnu_parallel_parse():
    words = shlex.split(code("bash", "parallel"))
    options, values = words[words.index("lieint") + 1 : words.index(":::")], words[words.index(":::") + 1 :]
    assert values == [str(k) for k in range(8)]
    for k in values:
        parsed = cli._parser().parse_args([word.replace("{}", k) for word in options])
        assert part_of_text(parsed.part) == (int(k), 8)


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
def test_the_file_and_the_command_run_on_a_dask_cluster(folder):
    distributed = pytest.importorskip("distributed")
    Path("dask_parts.py").write_text(code("py", "distributed"))
    subprocess.run([sys.executable, "dask_parts.py"], env=environment(), check=True)
    assert li.open(folder / "dask.zarr").state.q.shape == (5, 100, 4)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        command = ["run", "my.toml", "--out", "run.zarr", "--parts", "3", "--dask", cluster.scheduler_address]
        assert cli.main([*command, "--export", "nominal.csv"]) == 0
    run.run("my.toml", Path("whole.zarr"))
    assert_same(li.open("run.zarr").state, li.open("whole.zarr").state)
    assert Path("nominal.csv").exists()
