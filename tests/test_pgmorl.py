"""The seven tasks of Table 4.1, against reference returns, the facts of their models and hand-computed rewards."""

import os
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common import env_checker as sb3_env_checker
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_momba.envs.making import make_mo_vec_env
from sb3_momba.envs.pgmorl_physics import sums_margins
from sb3_momba.envs.registry import TASKS
from sb3_momba.envs.wrappers import PreferenceWrapper

IDS = sorted(TASKS)
BOTH = pytest.mark.parametrize("physics", ["2020", "current"])
EVERY_TASK = pytest.mark.parametrize("task", IDS)

MUJOCO_4_0 = mujoco.__version__.startswith("4.0")
# Other releases differ in their last digits, and Walker2d's fall with no action splits at changes of 1e-12.
TOLERANCE = 1e-6 if MUJOCO_4_0 else 1e-4

# (task, physics): body mass, return and length with no action, return and length with 0.3 of the upper bounds
REFERENCES = {
    ("MO-Hopper-v4", "2020"): (15.265, (195.901854, -111.235121), 369, (60.556943, 20.795010), 22),
    ("MO-Hopper-v4", "current"): (15.820, (192.493857, -106.002615), 365, (60.714252, 20.939641), 22),
    ("MO-Hopper-3obj-v4", "2020"): (15.265, (195.901854, -111.235121, 1845), 369, (60.566447, 20.804514, 62.479996), 22),
    ("MO-Hopper-3obj-v4", "current"): (15.820, (192.493857, -106.002615, 1825), 365, (60.723756, 20.949145, 62.479996), 22),
    ("MO-HalfCheetah-v4", "2020"): (14.0, (499.764113, 2500), 500, (499.368937, 2229.999979), 500),
    ("MO-HalfCheetah-v4", "current"): (14.0, (499.753627, 2500), 500, (499.394409, 2229.999979), 500),
    ("MO-Swimmer-v4", "2020"): (103.6726, (0, 150), 500, (14.768828, 136.499999), 500),
    ("MO-Swimmer-v4", "current"): (106.8142, (0, 150), 500, (14.777862, 136.499999), 500),
    ("MO-Walker2d-v4", "2020"): (34.047, (207.044671, 1150), 230, (259.344153, 633.319994), 142),
    ("MO-Walker2d-v4", "current"): (35.5157, (206.685441, 1145), 229, (255.448822, 615.479994), 138),
    ("MO-Ant-v4", "2020"): (0.8787, (500, 500), 500, (319.192197, 320.972806), 500),
    ("MO-Ant-v4", "current"): (0.9109, (500, 500), 500, (319.217063, 320.943351), 500),
}


def episode(env: gym.Env, action: np.ndarray) -> tuple[np.ndarray, int]:
    """Return and length of one episode of the same action."""
    env.reset(seed=0)
    total, steps, done = 0.0, 0, False
    while not done:
        _, reward, terminated, truncated, _ = env.step(action)
        total, steps, done = total + reward, steps + 1, terminated or truncated
    return np.asarray(total), steps


def trajectory(env: gym.Env, seed: int, steps: int = 30) -> np.ndarray:
    """Observations and rewards of a random policy, one row per step."""
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    rows = [np.concatenate([observation, np.zeros(env.get_wrapper_attr("reward_space").shape)])]
    for _ in range(steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        rows.append(np.concatenate([observation, reward]))
    return np.array(rows)


def freeze(monkeypatch: pytest.MonkeyPatch, env: gym.Env) -> None:
    """Let steps leave the state as it is."""
    monkeypatch.setattr(env.unwrapped, "do_simulation", lambda action, n_frames: None)


@pytest.mark.parametrize(("task", "physics"), list(REFERENCES))
def test_reference_returns(task, physics):
    if physics == "current" and not MUJOCO_4_0:
        pytest.skip(f"the references are MuJoCo 4.0's, this is {mujoco.__version__}")
    _, no_action, no_action_steps, constant, constant_steps = REFERENCES[task, physics]
    env = gym.make(task, physics=physics)
    total, steps = episode(env, 0 * env.action_space.high)
    np.testing.assert_allclose(total, no_action, rtol=TOLERANCE, atol=1e-6)
    assert steps == no_action_steps
    total, steps = episode(env, np.float32(0.3) * env.action_space.high)
    np.testing.assert_allclose(total, constant, rtol=TOLERANCE, atol=1e-6)
    assert steps == constant_steps


@pytest.mark.parametrize(("task", "physics", "mass"), [(*key, row[0]) for key, row in REFERENCES.items()])
def test_body_mass(task, physics, mass):
    # Masses are given to four decimals.
    assert gym.make(task, physics=physics).unwrapped.model.body_mass.sum() == pytest.approx(mass, abs=6e-5)


def test_body_mass_of_the_humanoid():
    # Rounded to three decimals in the reference.
    assert gym.make("MO-Humanoid-v4").unwrapped.model.body_mass.sum() == pytest.approx(39.646, abs=6e-4)


def test_models_are_edited_as_declared():
    """Gears, damping, limits, control ranges, contacts and what gymnasium's model says for everything else."""
    model = {task: gym.make(task, physics="current").unwrapped.model for task in IDS}
    np.testing.assert_array_equal(model["MO-Ant-v4"].actuator_gear[:, 0], 100)
    np.testing.assert_array_equal(model["MO-Swimmer-v4"].actuator_gear[:, 0], 300)
    assert model["MO-Swimmer-v4"].opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    np.testing.assert_array_equal(model["MO-HalfCheetah-v4"].actuator_gear[:, 0], [120, 90, 60, 120, 60, 30])
    np.testing.assert_array_equal(model["MO-Walker2d-v4"].actuator_gear[:, 0], 100)
    np.testing.assert_array_equal(model["MO-Walker2d-v4"].dof_damping, [0, 0, 0, 3, 3, 3, 3, 3, 3])
    np.testing.assert_array_equal(model["MO-Walker2d-v4"].jnt_limited, [0, 0, 0, 1, 1, 1, 1, 1, 1])
    feet = [model["MO-Walker2d-v4"].geom(name).friction[0] for name in ("foot_geom", "foot_left_geom")]
    np.testing.assert_array_equal(feet, [0.9, 1.9])
    for task in ("MO-Hopper-v4", "MO-Hopper-3obj-v4"):
        np.testing.assert_array_equal(model[task].actuator_gear[:, 0], [200, 200, 300])
        np.testing.assert_array_equal(model[task].actuator_ctrlrange, [[-2, 2], [-2, 2], [-4, 4]])
        np.testing.assert_array_equal(model[task].dof_damping, [0, 0, 0, 40, 40, 40])
        np.testing.assert_array_equal(model[task].jnt_limited, 0)
    for task in ("MO-Ant-v4", "MO-HalfCheetah-v4", "MO-Swimmer-v4", "MO-Walker2d-v4"):
        np.testing.assert_array_equal(np.unique(model[task].actuator_ctrlrange), [-1, 1])
    np.testing.assert_array_equal(np.unique(model["MO-Humanoid-v4"].actuator_ctrlrange), [-0.4, 0.4])


@pytest.mark.parametrize(("physics", "half_length"), [("2020", 0.2 + 0.05 / 2), ("current", 0.2)])
def test_inertia_of_a_capsule(physics, half_length):
    """Hopper's torso, radius 0.05, half-length 0.2, density 1000: a cylinder of half-length h + r/2, or a true capsule."""
    radius, length = 0.05, 2 * half_length
    mass = 1000 * np.pi * radius**2 * length
    axial, transverse = mass * radius**2 / 2, mass * (3 * radius**2 + length**2) / 12
    if physics == "current":
        caps = 1000 * 4 / 3 * np.pi * radius**3
        axial += caps * 2 / 5 * radius**2
        transverse += caps * (2 / 5 * radius**2 + length**2 / 4 + 3 / 8 * length * radius)
        mass += caps
    torso = gym.make("MO-Hopper-v4", physics=physics).unwrapped.model.body("torso")
    np.testing.assert_allclose(torso.mass, mass)
    np.testing.assert_allclose(np.sort(torso.inertia.ravel()), [axial, transverse, transverse])


@pytest.mark.parametrize(("task", "margin", "lowered"), [("MO-Hopper-v4", 0.001, 0.05), ("MO-Ant-v4", 0.01, 0.51)])
@BOTH
def test_margin_of_contacts(task, margin, lowered, physics):
    """Two equal margins count once in 2020, twice since they are summed."""
    env = gym.make(task, physics=physics).unwrapped
    env.reset()
    env.data.qpos[env.height_index] -= lowered
    mujoco.mj_forward(env.model, env.data)
    assert env.data.ncon > 0
    expected = 2 * margin if physics == "current" and sums_margins() else margin
    np.testing.assert_allclose([contact.includemargin for contact in env.data.contact], expected)


@BOTH
@EVERY_TASK
def test_constants_follow_the_masses(task, physics):
    """What the compiler derives from inertias belongs to those the model has."""
    model = gym.make(task, physics=physics).unwrapped.model
    assert model.stat.meaninertia == pytest.approx(model.dof_M0.mean(), rel=1e-12)
    assert model.stat.meanmass == pytest.approx(model.body_mass[1:].mean(), rel=1e-12)
    np.testing.assert_allclose(model.body_subtreemass[0], model.body_mass.sum(), rtol=1e-12)


def test_current_physics_is_the_installed_release():
    """HalfCheetah is Gymnasium's own model; its total mass is set after compiling, which must change nothing."""
    ours = gym.make("MO-HalfCheetah-v4", physics="current").unwrapped.model
    theirs = gym.make("HalfCheetah-v5").unwrapped.model
    names = [name for name in dir(theirs) if isinstance(getattr(theirs, name), np.ndarray)]
    assert "body_inertia" in names
    for name in names:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    assert ours.stat.meaninertia == pytest.approx(theirs.stat.meaninertia, rel=1e-14)


def test_compiling_warns_of_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for task in IDS:
        gym.make(task)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


def test_spaces():
    shapes = {task: gym.make(task).observation_space.shape for task in IDS}
    assert shapes == {
        "MO-Ant-v4": (27,),
        "MO-HalfCheetah-v4": (17,),
        "MO-Hopper-v4": (11,),
        "MO-Hopper-3obj-v4": (11,),
        "MO-Humanoid-v4": (376,),
        "MO-Swimmer-v4": (8,),
        "MO-Walker2d-v4": (17,),
    }
    for task in IDS:
        env = gym.make(task).unwrapped
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        observation, reward, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert env.reward_space.contains(reward)
        assert env.reward_space.shape == (len(env.objectives),) == ((3,) if "3obj" in task else (2,))


# x moves by 1 m/s, every action is twice the upper bound and z as it was: rewards by hand.
@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("MO-Ant-v4", (1 - 3, 0 - 3)),
        ("MO-HalfCheetah-v4", (2, 5 - 6)),
        ("MO-Hopper-v4", (1.5 + 1 - 0.0048, 1 - 0.0048)),
        ("MO-Hopper-3obj-v4", (2.5, 1, 5 - 24)),
        ("MO-Humanoid-v4", (4.25, 6 - 4 * 2.72)),
        ("MO-Swimmer-v4", (1, 0)),
        ("MO-Walker2d-v4", (2, 5 - 6)),
    ],
)
def test_rewards_by_hand(task, expected, monkeypatch):
    env = gym.make(task).unwrapped
    env.reset(seed=0)

    def move(action: np.ndarray, n_frames: int) -> None:
        np.testing.assert_allclose(action, env.action_space.high, rtol=1e-6)
        positions = {"MO-Ant-v4": env.data.xpos[:, 0], "MO-Humanoid-v4": env.data.xipos[:, 0]}
        moved = positions.get(task, env.data.qpos[:1])
        moved += env.dt

    monkeypatch.setattr(env, "do_simulation", move)
    _, reward, _, _, info = env.step(2 * env.action_space.high)
    np.testing.assert_allclose(reward, expected, atol=1e-12)
    assert info["x_velocity"] == pytest.approx(1)
    assert info["energy"] == pytest.approx(np.square(env.model.actuator_ctrlrange[:, 1]).sum())


def test_rewards_of_speed_and_height(monkeypatch):
    cheetah, hopper = gym.make("MO-HalfCheetah-v4").unwrapped, gym.make("MO-Hopper-3obj-v4").unwrapped
    for env, index, by in ((cheetah, 0, 10 * cheetah.dt), (hopper, 1, 0.25)):
        env.reset()
        monkeypatch.setattr(env, "do_simulation", lambda *_, q=env.data.qpos, i=index, by=by: q.__setitem__(i, q[i] + by))
    assert cheetah.step(np.zeros(6))[1].tolist() == [5, 5]  # not more than 4 m/s count
    np.testing.assert_allclose(hopper.step(np.zeros(3))[1], [1, 4, 5])


@pytest.mark.parametrize(
    ("task", "index", "inside", "towards"),
    [
        ("MO-HalfCheetah-v4", 2, np.nextafter(np.deg2rad(50), 0), np.inf),
        ("MO-HalfCheetah-v4", 2, -np.nextafter(np.deg2rad(50), 0), -np.inf),
        *[(task, 1, np.nextafter(0.4, 1), -np.inf) for task in ("MO-Hopper-v4", "MO-Hopper-3obj-v4")],
        *[("MO-Hopper-v4", joint, np.nextafter(np.pi / 2, 0), np.inf) for joint in (2, 3, 4, 5)],
        *[("MO-Hopper-3obj-v4", joint, -np.nextafter(np.pi / 2, 0), -np.inf) for joint in (2, 3, 4, 5)],
        ("MO-Humanoid-v4", 2, 1.0, -np.inf),
        ("MO-Humanoid-v4", 2, 2.0, np.inf),
        ("MO-Walker2d-v4", 1, np.nextafter(0.8, 1), -np.inf),
        ("MO-Walker2d-v4", 1, np.nextafter(2.0, 0), np.inf),
        ("MO-Walker2d-v4", 2, np.nextafter(1.0, 0), np.inf),
        ("MO-Walker2d-v4", 2, -np.nextafter(1.0, 0), -np.inf),
    ],
)
def test_terminates_exactly_at_the_bounds(task, index, inside, towards, monkeypatch):
    """The last number inside goes on, the next one ends the episode."""
    env = gym.make(task).unwrapped
    freeze(monkeypatch, env)
    for value, expected in ((inside, False), (np.nextafter(inside, towards), True), (np.nan, True)):
        env.reset(seed=0)
        env.data.qpos[index] = value
        assert env.step(np.zeros(env.action_space.shape))[2] is expected


def test_ant_terminates_when_not_finite_and_swimmer_never(monkeypatch):
    ant, swimmer = gym.make("MO-Ant-v4").unwrapped, gym.make("MO-Swimmer-v4").unwrapped
    for env in (ant, swimmer):
        freeze(monkeypatch, env)
    for value, expected in ((1e6, False), (-1e6, False), (np.inf, True), (np.nan, True)):
        for state in ("qpos", "qvel"):
            ant.reset()
            getattr(ant.data, state)[2] = value
            assert ant.step(np.zeros(8))[2] is expected
            swimmer.reset()
            getattr(swimmer.data, state)[2] = value
            assert swimmer.step(np.zeros(2))[2] is False


def test_truncation():
    limits = {task: gym.spec(task).max_episode_steps for task in IDS}
    assert limits == {task: 1000 if task == "MO-Humanoid-v4" else 500 for task in IDS}
    env = gym.make("MO-Swimmer-v4")
    env.reset()
    ends = [env.step(env.action_space.high)[2:4] for _ in range(500)]
    assert ends == [(False, False)] * 499 + [(False, True)]


@BOTH
@EVERY_TASK
def test_same_seed_same_steps(task, physics):
    env = gym.make(task, physics=physics)
    first = trajectory(env, seed=3)
    np.testing.assert_array_equal(trajectory(env, seed=3), first)
    np.testing.assert_array_equal(trajectory(gym.make(task, physics=physics), seed=3), first)
    copy = pickle.loads(pickle.dumps(env))
    assert copy.unwrapped.physics == physics
    np.testing.assert_array_equal(trajectory(copy, seed=3), first)


def test_same_seed_same_steps_in_subprocesses():
    rewards = []
    for vec_env_cls in (DummyVecEnv, SubprocVecEnv):
        venv = make_mo_vec_env("sb3_momba.envs.pgmorl:MO-Humanoid-v4", 2, seed=5, vec_env_cls=vec_env_cls)
        rows = [venv.reset()]
        for _ in range(5):
            observations, _, _, infos = venv.step(np.full((2, 17), 0.1, dtype=np.float32))
            rows += [observations, np.stack([info["vector_reward"] for info in infos])]
        assert venv.get_attr("deterministic") == [False, False]
        venv.close()
        rewards.append(rows)
    for one, other in zip(*rewards, strict=True):
        np.testing.assert_array_equal(one, other)


@EVERY_TASK
def test_deterministic_as_declared(task):
    env = gym.make(task)
    starts = [env.reset(seed=seed)[0] for seed in (0, 1)]
    assert env.unwrapped.deterministic == (task != "MO-Humanoid-v4")
    assert np.array_equal(*starts) == env.unwrapped.deterministic


def test_reset_noise_of_the_humanoid():
    env = gym.make("MO-Humanoid-v4").unwrapped
    noise = []
    for seed in range(50):
        env.reset(seed=seed)
        noise.append(np.concatenate([env.data.qpos - env.init_qpos, env.data.qvel - env.init_qvel]))
    assert np.shape(noise) == (50, 47)
    assert 0.0099 < np.max(noise) < 0.01
    assert -0.01 < np.min(noise) < -0.0099


def test_contact_forces_of_the_humanoid():
    """The last 84 entries, zero in 2020, are the forces on the bodies once it has fallen."""
    forces = {}
    for physics in ("2020", "current"):
        env = gym.make("MO-Humanoid-v4", physics=physics).unwrapped
        env.reset(seed=0)
        forces[physics] = [env.step(np.zeros(17))[0][-84:] for _ in range(100)]
    assert np.count_nonzero(forces["2020"]) == 0
    assert np.count_nonzero(forces["current"]) > 0


@EVERY_TASK
def test_gymnasium_checker(task):
    env = gym.make(task).unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    messages = {str(warning.message) for warning in caught}
    expected = ["reward returned by `step()`", "observation space minimum", "observation space maximum"]
    if "Hopper" in task:
        expected.append("normalized space")  # Its actions reach 2 and 4.
    unexpected = [message for message in messages if not any(part in message for part in expected)]
    assert not unexpected


@EVERY_TASK
def test_sb3_checker(task):
    env = PreferenceWrapper(gym.make(task))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized Box action space.*")
        sb3_env_checker.check_env(env, skip_render_check=True)


def test_an_id_that_is_there_already_stays_as_it_is():
    script = """
import gymnasium, warnings
warnings.simplefilter("error", UserWarning)
gymnasium.register("MO-Hopper-v4", entry_point="somewhere:Else", max_episode_steps=7)
import sb3_momba
print(gymnasium.spec("MO-Hopper-v4").entry_point, gymnasium.spec("MO-Ant-v4").entry_point)
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["somewhere:Else", "sb3_momba.envs.pgmorl:MOAnt"]


def test_whoever_draws_nothing_needs_no_opengl():
    script = "import gymnasium, sb3_momba; gymnasium.make('MO-Ant-v4').reset()"
    subprocess.run([sys.executable, "-c", script], env={**os.environ, "MUJOCO_GL": "vulkan"}, check=True)


@EVERY_TASK
def test_info_and_reset_options(task):
    env = gym.make(task)
    _, info = env.reset(seed=0, options={"unknown": 1})
    names = {"x_position"} | ({"y_position"} if task in ("MO-Ant-v4", "MO-Humanoid-v4") else set())
    names |= set() if task == "MO-Swimmer-v4" else {"z_position"}
    assert set(info) == names
    info = env.step(env.action_space.high)[4]
    assert set(info) == names | {f"{name[0]}_velocity" for name in names - {"z_position"}} | {"energy"}
    assert all(type(value) is float for value in info.values())


def test_errors():
    with pytest.raises(ValueError, match=r"physics='2019' is not known: '2020' .* 'current'"):
        gym.make("MO-Hopper-v4", physics="2019")
    env = gym.make("MO-Hopper-v4")
    env.reset()
    with pytest.raises(ValueError, match=r"MOHopper: the action has shape \(1,\), not \(3,\)"):
        env.step(np.zeros(1))


RENDER = """
import gymnasium, numpy
import sb3_momba
for mode, shape in (("rgb_array", (120, 160, 3)), ("depth_array", (120, 160))):
    env = gymnasium.make("MO-Walker2d-v4", render_mode=mode, width=160, height=120)
    env.reset(seed=0)
    frame = env.render()
    assert frame.shape == shape and frame.std() > 0, (frame.shape, frame.std())
    assert env.metadata["render_fps"] == 125
    env.close()
print("rendered")
"""


def test_rendering():
    """In a process of its own: MuJoCo chooses its context when it is imported."""
    reasons = []
    for backend in ("egl", "osmesa"):
        environment = {**os.environ, "MUJOCO_GL": backend}
        run = subprocess.run([sys.executable, "-c", RENDER], env=environment, capture_output=True, text=True, timeout=60)
        if "rendered" in run.stdout:
            return
        assert "AssertionError" not in run.stderr, run.stderr
        reasons.append(f"{backend}: {(run.stderr.strip().splitlines() or ['no message'])[-1]}")
    pytest.skip("no context to render in; " + "; ".join(reasons))
