"""What installed packages bring by their entry points: found whatever ran before, named where they fail."""

import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl import plugins
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.tasks import TASKS, find_task

TASK = """
import multilift_marl as ml
from multilift_marl.tasks.hover import Hover

class Near(Hover):
    name = "near"
"""
LONG = {"task": "near", "env": {"episode_seconds": 3.0}, "train": {"frames": 777}}
FLEET = """
import multilift_marl as ml
ml.register_vehicle("heavy", preset="falcon", mass=0.7)
ml.register_config("rigs/heavy", {"vehicle": {"preset": "heavy"}})
"""


@pytest.fixture
def install(tmp_path, monkeypatch, registries):
    """Return a function that puts a package with entry points and modules where installed ones are."""

    def put(entries, **modules):
        for name, source in modules.items():
            (tmp_path / f"{name}.py").write_text(source)
        info = tmp_path / "kit_tasks-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: kit-tasks\nVersion: 1.0\n")
        lines = "".join(f"{name} = {value}\n" for name, value in entries.items())
        (info / "entry_points.txt").write_text(f"[multilift_marl.tasks]\n{lines}")

    monkeypatch.syspath_prepend(tmp_path)
    plugins.load_entry_points.cache_clear()
    yield put
    plugins.load_entry_points.cache_clear()


# Found


@pytest.mark.parametrize("entry", ["kit_tasks:Near", "kit_tasks"])
def test_tasks_of_installed_packages_are_known(install, entry):
    install({"near": entry}, kit_tasks=TASK + ("" if ":" in entry else "\nml.register_task(Near)"))
    assert ml.make_vec("near", num_envs=1, num_threads=1).task.name == "near"
    assert "near" in ml.list_tasks()


@pytest.mark.parametrize("entry", ["kit_tasks:Near", "kit_tasks"])
def test_a_task_keeps_the_configuration_that_its_module_registers(install, entry):
    install({"near": entry}, kit_tasks=f"{TASK}\nml.register_task(Near, {LONG})")
    assert ml.list_tasks() and TASKS["near"].name == "near"
    config = load_config("near")
    assert (config.task, config.env.episode_seconds, config.train.frames) == ("near", 3.0, 777)


def test_the_first_look_at_a_task_of_an_installed_package_finds_its_configuration(install):
    install({"near": "kit_tasks:Near"}, kit_tasks=f"{TASK}\nml.register_task(Near, {LONG})")
    first = load_config("rigs/auto6", {"task": "near"})
    assert (first.env.num_drones, first.env.episode_seconds, first.train.frames) == (6, 3.0, 777)
    assert load_config("rigs/auto6", {"task": "near"}) == first


def test_the_vehicle_of_an_installed_package_is_found_before_anything_else_of_it(install):
    install({"fleet": "kit_fleet"}, kit_fleet=FLEET)
    assert load_config("hover", {"vehicle.preset": "heavy"}).system.vehicle.mass == 0.7


def test_a_module_may_use_what_another_entry_point_brings(install, recwarn):
    stout = '\nml.register_vehicle("stout", preset="heavy", arm=0.3)\n'
    head, task = TASK.split("class", 1)
    install({"a": "kit_tasks:Near", "b": "kit_fleet"}, kit_tasks=f"{head}{stout}class{task}", kit_fleet=FLEET)
    assert {"near"} <= set(ml.list_tasks()) and not recwarn.list
    vehicle = load_config("near", {"vehicle.preset": "stout"}).system.vehicle
    assert (vehicle.mass, vehicle.arm) == (0.7, 0.3)


# Failing


@pytest.mark.filterwarnings("ignore:the task 'near' of kit-tasks")
def test_a_package_that_fails_is_named_and_leaves_the_others_alone(install):
    install({"near": "kit_tasks:Near", "b": "kit_fleet"}, kit_tasks="import nosuchlibrary", kit_fleet=FLEET)
    why = (
        "the task 'near' of kit-tasks (kit_tasks:Near) cannot be loaded: ModuleNotFoundError in kit_tasks.py, line 1 "
        "(No module named 'nosuchlibrary')"
    )
    with pytest.warns(UserWarning, match="the task 'near' of kit-tasks"):
        assert "near" not in ml.list_tasks()
    assert load_config("rigs/heavy").system.vehicle.mass == 0.7
    assert refusal(MultiliftVec, build_config({"task": "near"})) == why
    assert refusal(load_config, "near") == why


@pytest.mark.filterwarnings("ignore:the module 'more' of kit-tasks")
def test_a_module_that_fails_is_named_wherever_something_is_not_known(install):
    install({"more": "kit_fleet"}, kit_fleet="import nosuchlibrary")
    why = (
        "; the module 'more' of kit-tasks (kit_fleet) cannot be loaded: ModuleNotFoundError in kit_fleet.py, line 1 "
        "(No module named 'nosuchlibrary')"
    )
    for call, message in (
        (lambda: load_config("hover", {"vehicle.preset": "heavy"}).system, "unknown vehicle.preset 'heavy'; known: "),
        (lambda: load_config("rigs/heavi"), "no configuration named 'rigs/heavi'; "),
        (lambda: find_task("near"), "unknown task 'near'; known: "),
    ):
        told = refusal(call)
        assert told.startswith(message) and told.endswith(why)
