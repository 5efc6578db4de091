"""The package as users get it: the wheel, the base without torch, the documents."""

import gc
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from conftest import load_script
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import multilift_marl as ml
from multilift_marl.cli.benchmark import main as benchmark
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.cli.export import main as export
from multilift_marl.cli.plan import main as plan
from multilift_marl.cli.train import main as train
from multilift_marl.config.load import list_configs
from multilift_marl.errors import pip_install
from multilift_marl.evaluation import plots
from multilift_marl.kernels.cache import cache_folder
from multilift_marl.mdp.failures import CAUSES
from multilift_marl.schema.sections import PushConfig, RandomizationConfig

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))  # each from top to bottom, in one folder


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
    kernels = str(cache_folder("multilift_marl.math3d").parents[1])
    done = python(code, tmp_path, PYTHONPATH=str(tmp_path / "site"), NUMBA_CACHE_DIR=kernels)
    assert done.stdout.strip() == "(2, 4)", done.stderr


@pytest.mark.slow
def test_the_wheel_plans_paths(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    code = (
        "import sys; from multilift_marl.plan import main; "
        "sys.exit(main(['waypoints=[[0, 0, 1.5], [2, 1, 2, 0.5]]', 'out=path.csv']))"
    )
    kernels = str(cache_folder("multilift_marl.math3d").parents[1])
    done = python(code, tmp_path, PYTHONPATH=str(tmp_path / "site"), NUMBA_CACHE_DIR=kernels)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "path.csv").read_text().startswith("t,x,y,z,yaw\n0,0,0,1.5,0\n")


BASES = """
import multilift_marl as ml
from multilift_marl.config.load import build_config, list_configs
from multilift_marl.policies.baselines import base_matrix
from multilift_marl.envs.core import MultiliftVec
for name in list_configs():
    config = ml.load_config(name)
    if name.startswith(("rigs/", "conditions/")):
        continue
    small = {"env.num_envs": 1, "env.num_threads": 1}
    vec = MultiliftVec(build_config(config.model_dump(), config.train.overrides | small))
    matrix = base_matrix(config.train.residual, vec)
    print(name, config.train.residual, f"{abs(matrix).max():.3f}")
"""


@pytest.mark.slow
def test_every_recipe_can_be_trained_where_nothing_but_the_wheel_is(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    (tmp_path / "empty").mkdir()
    done = python(BASES, tmp_path / "empty", PYTHONPATH=str(tmp_path / "site"), NUMBA_DISABLE_JIT="1")
    assert done.returncode == 0, done.stderr
    bases = {name: (base, float(most)) for name, base, most in (line.split() for line in done.stdout.splitlines())}
    folder = ROOT / "configs"
    recipes = {path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml")}
    recipes = {name for name in recipes if not name.startswith(("rigs/", "conditions/"))}
    assert bases.keys() == recipes and len(recipes) >= 36
    for name, (base, most) in bases.items():
        assert ":" not in base and (most > 0) == (base != "formation"), name


@pytest.mark.slow
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
    assert last == f"ModuleNotFoundError: ml.{name} needs torch: {pip_install('train')}"


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


def test_documents_name_every_task_and_failure(task):
    common = (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8")
    assert f"[{task}]({task}.md)" in common
    assert re.findall(r"^\| `(\w+)` \|", common, re.MULTILINE) == list(CAUSES[1:])


def test_the_tables_of_hidden_parameters_are_complete():
    text = (ROOT / "docs" / "randomization.md").read_text()
    known = [*RandomizationConfig.model_fields, *PushConfig.model_fields]
    assert re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE) == known


@pytest.mark.parametrize("document", DOCUMENTS + TUTORIALS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_and_files_of_documents_exist(document):
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        if not target.startswith("http"):
            assert (document.parent / target).exists(), target


def blocks(language, document):
    return re.findall(rf"```{language}\n(.*?)```", document.read_text(), re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("code", [b for d in DOCUMENTS for b in blocks("python", d)])
def test_python_of_documents_runs(code, tmp_path):
    done = python(code, tmp_path)
    assert done.returncode == 0, done.stderr


def commands():
    for document in DOCUMENTS:
        for block in blocks("bash", document):
            yield from commands_of(block)


def commands_of(block):
    for line in block.replace("\\\n", " ").splitlines():
        for part in line.split("&&"):
            part = part.split("#")[0].strip()
            if part.startswith("python ") and "-m venv" not in part:
                yield part


SHORT = (  # one iteration
    "env.num_envs=4 env.episode_seconds=0.4 train.horizon=8 train.frames=32 train.diffmpc.window=4 eval.episodes=2"
)
SHORTER = {  # of each script: what is added, in place of the same keys; then keys that go without any
    "train.py": (SHORT,),
    "evaluate.py": ("episodes=1 env.episode_seconds=0.4",),
    "bench/air.py": ("repeats=1 seconds=0.05 env.num_envs=4",),
    "bench/bench.py": ("repeats=1 seconds=0.05 env.num_envs=4",),
    "bench/disturbance.py": ("rigs=report4 seconds=0.05",),
    "bench/numpy_functions.py": ("repeats=1 seconds=0.05 env.num_envs=4",),
    "bench/obstacles.py": ("obstacles=2 repeats=1",),
    "bench/peers.py": ("peers=multilift_marl repeats=1 seconds=0.05", "cache", "save"),
    "bench/randomization.py": ("repeats=1 seconds=0.05 env.num_envs=4",),
    "bench/route_search.py": ("maps=1 drones=2",),
    "bench/start.py": ("repeats=1 num_envs=2", "task", "install"),
    "bench/soak.py": ("minutes=0.01 iterations=8 task=hover", "steps", "num_envs"),
    "bench/tasks.py": ("repeats=1 seconds=0.02 env.num_envs=4",),
    "bench/workers.py": ("repeats=1 workers=0,1 env.num_envs=4 train.horizon=8",),
    "bench/training.py": (f"repeats=1 {SHORT} train.minibatches=2",),
    "multilift_marl.benchmark": ("episodes=1", "suite"),
    "results/search_gains.py": ("minutes=0.001 env.num_envs=2 env.episode_seconds=2.0",),
    "results/shifts.py": ("episodes=2",),
    "results/twin.py": ("episodes=2 rounds=1 env.episode_seconds=0.4",),
    "results/curves.py": (".",),  # folder
    "examples/cleanrl_ppo.py": ("1",),  # iteration
    "examples/fly_exported.py": ("1",),
    "examples/ray_tune.py": (f"2 {SHORT}", "16"),  # trials
}
MAINS = {
    "train.py": train,
    "evaluate.py": evaluate,
    "multilift_marl.export": export,
    "multilift_marl.benchmark": benchmark,
    "multilift_marl.plan": plan,
}


def shorter(command):
    """Return the script of a documented command and its arguments, made short."""
    _, script, *arguments = shlex.split(command.replace("python -m", "python"))
    more, *gone = SHORTER.get(script, ("",))
    dropped = [*gone, *re.findall(r"(\S+)=", more)]
    kept = [part for part in arguments if part.split("=")[0] not in dropped or "resume" in command]
    kept = [part.replace("=examples/", f"={ROOT}/examples/") for part in kept]
    for name in set(re.findall(r"config=(\S+)", command)) & set(list_configs()):
        envs = max(4, len(ml.load_config(name).train.rigs))  # at least one of each rig
        more = more.replace("num_envs=4", f"num_envs={envs}").replace("frames=32", f"frames={8 * envs}")
    return script, kept + ("" if "resume" in command else more).split()


def run(command, folder, monkeypatch):
    """Run a documented command, in this process where it has a function: starting Python takes the longest."""
    script, arguments = shorter(command)
    if script in MAINS:
        monkeypatch.chdir(folder)
        assert MAINS[script](arguments) == 0, command
        return
    if script == "bench/start.py":  # what a first step takes, tests/kernels/test_start.py takes already
        bench = load_script("bench/start")
        monkeypatch.setattr(bench, "STEP", bench.IMPORT)
        bench.main(arguments)
        return
    if script == "bench/soak.py":  # seconds each time, of all that the tests' process holds
        monkeypatch.setattr(gc, "collect", lambda: 0)
    if script.startswith(("bench/", "results/")):
        monkeypatch.chdir(folder)
        monkeypatch.syspath_prepend(str((ROOT / script).parent))
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        try:
            runpy.run_path(str(ROOT / script), run_name="__main__")
        except SystemExit as end:
            assert not end.code, f"{command}: {end.code}"
        return
    line = [sys.executable, *([str(ROOT / script)] if script.endswith(".py") else ["-m", script]), *arguments]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"


def of_documents():
    """Commands that train, those that follow one another after a training, and those that stand alone."""
    train, follow, alone = [], [], []
    once = {(script, *arguments): command for command in sorted(commands()) for script, arguments in [shorter(command)]}
    for (script, *_), command in once.items():
        if (script.endswith(".py") or script in MAINS) and script != "results/reproduce.py":  # which tests compare
            follows = script == "multilift_marl.export" or "=latest" in command or "runs/" in command
            kind = follow if follows else train if script == "train.py" else alone
            kind.append(command)
    return train, sorted(follow, key=lambda command: ("resume" in command, "export " not in command, command)), alone


def with_marks(commands):
    """Return the commands as parameters; what starts clusters, installs others, searches or films is long."""
    apart = re.compile(r"workers=2|bench/(workers|peers)|ray_tune|search_gains|video=true")
    return [pytest.param(each, marks=[pytest.mark.long] if apart.search(each) else []) for each in commands]


@pytest.mark.slow
@pytest.mark.parametrize("command", with_marks(of_documents()[0]))
def test_commands_that_train_run(command, tmp_path, monkeypatch, registries):
    (tmp_path / "results").symlink_to(ROOT / "results")  # whose scripts some recipes correct
    run(command, tmp_path, monkeypatch)


@pytest.mark.slow
def test_commands_that_follow_a_training_run(tmp_path, monkeypatch, registries):
    trainings, following, _ = of_documents()
    assert len(trainings) > 4
    assert any("run=latest" in command for command in following)
    for command in ("python train.py config=hover", *following):
        run(command, tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("command", with_marks(of_documents()[2]))
def test_commands_of_documents_run(command, tmp_path, monkeypatch, registries):
    (tmp_path / "results").symlink_to(ROOT / "results")
    monkeypatch.setattr(plots, "_save", lambda *arguments: None)  # most of the time; see test_evaluation.py
    run(command, tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("document", TUTORIALS, ids=lambda path: path.stem)
def test_tutorials_run_from_top_to_bottom(document, tmp_path, monkeypatch, registries):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.setattr(plots, "_save", lambda *arguments: None)
    done = 0
    for language, title, text in re.findall(
        r'```(\w+)(?: title="([^"]+)")?\n(.*?)```', document.read_text(), re.DOTALL
    ):
        if title:
            (tmp_path / title).write_text(text, encoding="utf-8")
        elif language == "python":
            ran = python(text, tmp_path, PYTHONPATH=f"{tmp_path}:{ROOT}")
            assert ran.returncode == 0, ran.stderr
            done += 1
        elif language == "bash":
            for command in commands_of(text):
                run(command, tmp_path, monkeypatch)
                done += 1
    assert done >= 2


def test_configs_only_override_what_exists():
    for name in (*ml.list_tasks(), "pose_easy"):
        values = yaml.safe_load((ROOT / "configs" / f"{name}.yaml").read_text())
        assert ml.load_config(name).task == values.get("task", values.get("base")) in ml.list_tasks()


def test_ci_runs_the_readmes_test_command():
    script = (ROOT / ".ci" / "run").read_text()
    block = next(block for block in blocks("bash", ROOT / "README.md") if "pytest" in block)
    for line in block.strip().splitlines():
        assert line.strip() in script, line


def test_the_known_versions_are_some_that_the_package_allows():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    known = {canonicalize_name(pin.name): str(pin.specifier) for pin in pins}
    assert len(known) == len(pins) and all(
        re.fullmatch(r"==[0-9.]+(\w[0-9]*|\.post[0-9]+)?", each) for each in known.values()
    )
    extras = [text for extra in project["optional-dependencies"].values() for text in extra]
    for need in map(Requirement, (*project["dependencies"], *extras)):
        name = canonicalize_name(need.name)
        if name != "multilift-marl":
            assert need.specifier.contains(known[name].removeprefix("==")), need
