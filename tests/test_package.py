"""The package as users get it: the wheel, the base without torch, the documents."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

import multilift_marl as ml
from multilift_marl.config.schema import RandomizationConfig
from multilift_marl.errors import pip_install
from multilift_marl.tasks import find_task
from multilift_marl.tasks.failures import CAUSES
from multilift_marl.tasks.observations import OBSERVATION

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def python(code, cwd, **environment):
    return subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, env=os.environ | environment
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(out.glob("*.whl"))


def test_wheel_carries_code_configs_and_policies(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert "multilift_marl/configs/hover.yaml" in names
    assert "multilift_marl/policies/hover.pt" in names
    assert "multilift_marl/py.typed" in names
    assert {name.split("/")[0] for name in names if "dist-info" not in name} == {"multilift_marl"}


def test_wheel_works_where_nothing_else_is(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    code = (
        "import multilift_marl as ml; assert 'site' in ml.__file__, ml.__file__; "
        "vec = ml.make_vec('hover', num_envs=2); obs, _ = vec.reset(seed=1); "
        "print(vec.step(ml.load_policy('hover').act(obs))[1].shape)"
    )
    done = python(code, tmp_path, PYTHONPATH=str(tmp_path / "site"))
    assert done.stdout.strip() == "(2, 4)", done.stderr


def test_base_needs_neither_torch_nor_a_display(tmp_path):
    code = (
        "import sys\n"
        "for name in ('torch', 'torchrl', 'tensordict', 'matplotlib', 'imageio', 'tqdm', 'tensorboard'):\n"
        "    sys.modules[name] = None\n"
        "import multilift_marl as ml\n"
        "from multilift_marl.envs import multilift_v0\n"
        "env = multilift_v0.parallel_env('hover')\n"
        "env.reset(seed=0)\n"
        "env.step({agent: env.action_space(agent).sample() for agent in env.agents})\n"
        "print(ml.list_tasks())\n"
    )
    done = python(code, tmp_path, DISPLAY="", MUJOCO_GL="")
    assert done.stdout.strip() == str(ml.list_tasks()), done.stderr
    assert not list(tmp_path.iterdir())


def test_missing_extra_is_named(tmp_path):
    code = "import sys; sys.modules['torch'] = None\nfrom multilift_marl.cli.train import main; sys.exit(main([]))"
    done = python(code, tmp_path)
    assert done.returncode == 2
    assert done.stderr == f"error: torch is missing; {pip_install('train')}\n"


@pytest.mark.parametrize("name", ["load_policy", "torchrl_env"])
def test_what_needs_torch_says_how_to_get_it(tmp_path, name):
    code = f"import sys; sys.modules['torch'] = None\nimport multilift_marl as ml; ml.{name}('hover')"
    last = python(code, tmp_path).stderr.splitlines()[-1]
    assert last == (
        f'ModuleNotFoundError: ml.{name} needs torch: pip install "multilift_marl[train]" '
        '(in a clone: pip install -e ".[train]")'
    )


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]])
def test_code_is_clean(command):
    done = subprocess.run([sys.executable, "-m", "ruff", *command, "."], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_public_names():
    assert set(ml.__all__) == {
        "list_tasks", "load_config", "load_policy", "make_vec", "parallel_env", "register_config", "register_task",
        "register_vehicle", "sim", "torchrl_env",
    }  # fmt: skip
    for name in ml.__all__:
        assert getattr(ml, name).__doc__


def test_documents_name_everything_about_a_task(task):
    kind, common = find_task(task), (ROOT / "docs" / "tasks.md").read_text()
    own = (ROOT / "docs" / f"{task}.md").read_text()
    assert f"[{task}]({task}.md)" in common
    for text, parts in ((common, OBSERVATION), (own, kind.EXTRA)):
        for part in parts:
            assert f"| `{part.name}` | {part.size} | {part.frame} | {part.unit} | {part.meaning} |" in text, part.name
    for term, weight in kind.REWARD.items():
        assert f"| `{term}` | {weight:g} |" in own, term
    for option in kind.Options.model_fields:
        assert f"`{option}`" in own, option
    for cause in CAUSES[1:]:
        assert f"`{cause}`" in common, cause


def test_the_table_of_hidden_parameters_is_complete():
    text = (ROOT / "docs" / "randomization.md").read_text()
    assert re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE) == list(RandomizationConfig.model_fields)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_and_files_of_documents_exist(document):
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        if not target.startswith("http"):
            assert (document.parent / target).exists(), target


def blocks(language, document):
    return re.findall(rf"```{language}\n(.*?)```", document.read_text(), re.DOTALL)


@pytest.mark.parametrize("code", [b for d in DOCUMENTS for b in blocks("python", d)])
def test_python_of_documents_runs(code, tmp_path):
    done = python(code, tmp_path)
    assert done.returncode == 0, done.stderr


def commands():
    for document in DOCUMENTS:
        for block in blocks("bash", document):
            for line in block.replace("\\\n", " ").splitlines():
                for part in line.split("&&"):
                    part = part.split("#")[0].strip()
                    if part.startswith("python ") and "-m venv" not in part:
                        yield part


def test_commands_of_documents_run_in_order(tmp_path):
    """Every `python …` of the documents runs, made short: trainings to one iteration, evaluations to two episodes."""
    seen = sorted(set(commands()), key=lambda command: ("train.py" not in command, "resume" in command, command))
    assert any("train.py config=hover" in command for command in seen)
    short = "env.num_envs=4 train.horizon=8 train.frames=32 eval.episodes=2"
    for command in seen:
        script = command.split()[1]
        if (script.startswith("-") and "multilift_marl.export" not in command) or script == "results/reproduce.py":
            continue  # other module commands, such as pytest itself; what would rewrite what tests compare
        if not script.startswith("-"):
            command = command.replace(script, str(ROOT / script), 1)
        command = command.replace("python", sys.executable, 1).replace("=examples/", f"={ROOT}/examples/")
        if script == "train.py" and "resume" not in command:
            for key in [part.split("=")[0] for part in short.split()]:  # each key is given once
                command = re.sub(rf" {re.escape(key)}=\S+", "", command)
            command += f" {short}"
        if script == "evaluate.py":
            command = re.sub(r"episodes=\d+", "episodes=2", command) + " env.episode_seconds=0.4"
        if script.startswith("examples/"):
            command += " 1"  # iteration
        if script in ("bench/air.py", "bench/bench.py", "bench/randomization.py"):
            command = re.sub(r" (repeats|seconds|env\.num_envs)=\S+", "", command)
            command += " repeats=1 seconds=0.05 env.num_envs=4"
        if script == "bench/training.py":
            command = command.split(" repeats=")[0] + f" repeats=1 {short} train.minibatches=2"
        if script == "results/search_gains.py":
            command = re.sub(r"minutes=\d+", "minutes=0.001", command) + " env.num_envs=2 env.episode_seconds=2.0"
        if script == "bench/tasks.py":
            command = command.split(" repeats=")[0] + " repeats=1 seconds=0.02"
        if script == "bench/disturbance.py":
            command = command.split(" rigs=")[0].replace("seconds=30", "") + " rigs=report4 seconds=0.05"
        done = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"


def test_configs_only_override_what_exists():
    for name in (*ml.list_tasks(), "pose_easy"):
        values = yaml.safe_load((ROOT / "configs" / f"{name}.yaml").read_text())
        assert values["task"] in ml.list_tasks()
        assert ml.load_config(name).task == values["task"]


def test_ci_runs_the_readmes_test_command():
    script = (ROOT / ".ci" / "run").read_text()
    block = next(block for block in blocks("bash", ROOT / "README.md") if "pytest" in block)
    for line in block.strip().splitlines():
        assert line.strip() in script, line
