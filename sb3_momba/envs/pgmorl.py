"""The seven continuous-control tasks of Table 4.1, from PGMORL (Xu et al., 2020, Prediction-Guided Multi-Objective
Reinforcement Learning for Continuous Robot Control).

`gymnasium.make("MO-Hopper-v4", physics="2020")`, once sb3_momba is imported. The models are those that Gymnasium ships,
edited as each class says. `physics="2020"`, the default, undoes what changed since the published fronts were made, on every
MuJoCo release from 3.2 on; `physics="current"` takes the model as the installed MuJoCo compiles it. Releases still differ in
their solvers and, since 4.0, in how RK4 turns the free bodies of Ant and Humanoid, by 1e-11 to 1e-7 per step.
"""

from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle

from sb3_momba.envs.pgmorl_physics import check_physics, compile_model, driven_joints, set_damping
from sb3_momba.envs.simulator import MujocoEnv, mujoco


class PgmorlEnv(MujocoEnv, EzPickle):
    """What the tasks share: the reward is a float64 vector, one entry per objective; a is the action clipped to its range,
    x, z and angle are qpos[0:3] of the planar bodies, and v is the change of x over one step, divided by its time `dt`.

    An episode starts in the model's own state, at rest. `info` holds `x_position` and `x_velocity`, `y_position` and
    `y_velocity` where y counts (m, m/s), `z_position` but for the Swimmer, and `energy`, the sum of a^2.

    :param physics: "2020" or "current"
    :param kwargs: of `gymnasium.envs.mujoco.MujocoEnv`: render_mode, width, height, camera_id, camera_name,
        default_camera_config, max_geom, visual_options
    :raises ValueError: for any other physics
    """

    model_file: ClassVar[str]
    frames_per_step: ClassVar[int]
    objectives: ClassVar[tuple[str, ...]]
    camera: ClassVar[dict[str, Any]]
    height_index: ClassVar[int | None] = 1
    unseen_positions: ClassVar[int] = 1
    largest_velocity: ClassVar[float] = np.inf
    deterministic: ClassVar[bool] = True
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}  # noqa: RUF012

    def __init__(self, physics: str | int = "2020", **kwargs: Any):
        EzPickle.__init__(self, physics, **kwargs)
        check_physics(physics)
        self.physics = str(physics)
        kwargs = {"default_camera_config": self.camera, **kwargs}
        MujocoEnv.__init__(self, self.model_file, self.frames_per_step, observation_space=None, **kwargs)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.dt)}
        self.observation_space = Box(-np.inf, np.inf, self._observe().shape, np.float64)
        self.reward_space = Box(-np.inf, np.inf, (len(self.objectives),), np.float64)

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        spec = mujoco.MjSpec.from_file(self.fullpath)
        self._edit(spec)
        model = compile_model(spec, self.physics)
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, self.width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, self.height)
        return model, mujoco.MjData(model)

    def step(  # type: ignore[override]
        self, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, bool, bool, dict[str, float]]:
        if np.shape(action) != self.action_space.shape:
            raise ValueError(f"{type(self).__name__}: the action has shape {np.shape(action)}, not {self.action_space.shape}.")
        # In float64, and to the model's own bounds: those of action_space are rounded to float32.
        a = np.clip(np.asarray(action, dtype=np.float64), *self.model.actuator_ctrlrange.T)
        before = self._position()
        self.do_simulation(a, self.frame_skip)
        velocity = (self._position() - before) / self.dt
        energy = float(np.square(a).sum())
        reward = np.array(self._rewards(velocity, energy))
        info = {**self._get_reset_info(), **_along_axes("velocity", velocity), "energy": energy}
        if self.render_mode == "human":
            self.render()  # type: ignore[no-untyped-call]
        return self._observe(), reward, not self.is_healthy, False, info

    def reset_model(self) -> np.ndarray:
        self.set_state(self.init_qpos, self.init_qvel)  # type: ignore[no-untyped-call]
        return self._observe()

    def _get_reset_info(self) -> dict[str, float]:
        info = _along_axes("position", self._position())
        if self.height_index is not None:
            info["z_position"] = float(self.data.qpos[self.height_index])
        return info

    @property
    def is_healthy(self) -> bool:
        """False where the episode ends."""
        return True

    @staticmethod
    def _edit(spec: mujoco.MjSpec) -> None:
        """Turn Gymnasium's model into the task's."""

    def _position(self) -> np.ndarray:
        """Where the body is along the axes that count, x and perhaps y."""
        return self.data.qpos[:1].copy()

    def _observe(self) -> np.ndarray:
        """qpos without its first entries, and qvel clipped; a fresh array."""
        qvel = np.clip(self.data.qvel, -self.largest_velocity, self.largest_velocity)
        return np.concatenate([self.data.qpos[self.unseen_positions :], qvel])

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        """One reward per objective, after the step."""
        raise NotImplementedError


def _along_axes(quantity: str, values: np.ndarray) -> dict[str, float]:
    return {f"{axis}_{quantity}": float(value) for axis, value in zip("xy", values, strict=False)}


class MOAnt(PgmorlEnv):
    """A four-legged body runs along x and y.

    - objectives: x-axis speed v_x + s and y-axis speed v_y + s of the torso (m/s), with s = 1 - 0.5 sum a^2
    - observation (27,): qpos without x and y, qvel
    - action (8,): hips and ankles, [-1, 1]
    - terminates when the state is not finite; truncated after 500 steps of 0.05 s
    - Gymnasium's ant.xml with gears of 100 (150 there), without contact forces in observation or reward and without
      reset noise
    """

    model_file = "ant.xml"
    frames_per_step = 5
    height_index = 2
    unseen_positions = 2
    objectives = ("x-axis speed", "y-axis speed")
    camera: ClassVar = {"distance": 4.0}

    @staticmethod
    def _edit(spec: mujoco.MjSpec) -> None:
        for actuator in spec.actuators:
            actuator.gear[0] = 100

    @property
    def is_healthy(self) -> bool:
        return bool(np.isfinite(self.state_vector()).all())

    def _position(self) -> np.ndarray:
        # Not qpos: xpos is that of the last intermediate state of the integrator.
        return self.data.body("torso").xpos[:2].copy()

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        s = 1 - 0.5 * energy
        return velocity[0] + s, velocity[1] + s


class MOHalfCheetah(PgmorlEnv):
    """A planar body with two legs runs along x.

    - objectives: forward speed min(4, v) + 1 (m/s), energy efficiency 4 - sum a^2 + 1
    - observation (17,): qpos without x, qvel
    - action (6,): thighs, shins and feet, [-1, 1]
    - terminates when the torso's angle reaches 50 degrees; truncated after 500 steps of 0.05 s
    - Gymnasium's half_cheetah.xml as it is, without reset noise
    """

    model_file = "half_cheetah.xml"
    frames_per_step = 5
    objectives = ("forward speed", "energy efficiency")
    camera: ClassVar = {"distance": 4.0}

    @property
    def is_healthy(self) -> bool:
        return bool(abs(self.data.qpos[2]) < np.deg2rad(50))

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        return min(4.0, velocity[0]) + 1, 4 - energy + 1


class MOHopper(PgmorlEnv):
    """A planar body with one leg hops along x.

    - objectives: forward speed 1.5 v + s (m/s), jumping height 12 (z - z_init) + s (m), with s = 1 - 2e-4 sum a^2
    - observation (11,): qpos without x, qvel clipped to +-10
    - action (3,): thigh and leg [-2, 2], foot [-4, 4]
    - terminates when z <= 0.4, or the angle of torso, thigh, leg or foot reaches 90 degrees; truncated after 500 steps of
      0.01 s
    - Gymnasium's hopper.xml with thigh, leg and foot unlimited and damped by 40 (1 there), gears 200, 200 and 300 (200
      there) and these control ranges (+-1 there), without reset noise
    """

    model_file = "hopper.xml"
    frames_per_step = 5
    largest_velocity = 10.0
    objectives: ClassVar[tuple[str, ...]] = ("forward speed", "jumping height")
    camera: ClassVar = {"trackbodyid": 2, "distance": 3.0, "lookat": (0.0, 0.0, 1.15), "elevation": -20.0}

    @staticmethod
    def _edit(spec: mujoco.MjSpec) -> None:
        for actuator, gear, bound in zip(spec.actuators, (200, 200, 300), (2, 2, 4), strict=True):
            actuator.gear[0] = gear
            actuator.ctrlrange = [-bound, bound]
        for joint in driven_joints(spec):
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            set_damping(joint, 40)

    @property
    def is_healthy(self) -> bool:
        return bool(self.data.qpos[1] > 0.4 and (np.abs(self.data.qpos[2:6]) < np.deg2rad(90)).all())

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        s = 1 - 2e-4 * energy
        return 1.5 * velocity[0] + s, 12 * self._rise() + s

    def _rise(self) -> float:
        """z - z_init."""
        return float(self.data.qpos[1] - self.init_qpos[1])


class MOHopper3(MOHopper):
    """`MOHopper` with its energy as an objective of its own.

    - objectives: forward speed 1.5 v + 1 (m/s), jumping height 12 (z - z_init) + 1 (m), efficiency 4 - sum a^2 + 1
    - everything else as in `MOHopper`
    """

    objectives: ClassVar[tuple[str, ...]] = ("forward speed", "jumping height", "efficiency")

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        return 1.5 * velocity[0] + 1, 12 * self._rise() + 1, 4 - energy + 1


class MOHumanoid(PgmorlEnv):
    """A two-legged body walks along x.

    - objectives: forward speed 1.25 v + 3 of the mass centre (m/s), energy efficiency 3 - 4 sum a^2 + 3
    - observation (376,): qpos without x and y, qvel, and of all bodies, the world included, cinert, cvel, qfrc_actuator
      and cfrc_ext; the last, 84 contact forces, are zero with physics="2020", as they were
    - action (17,): [-0.4, 0.4]
    - terminates when z < 1 or z > 2; truncated after 1000 steps of 0.015 s
    - Gymnasium's humanoid.xml as it is; the first qpos and qvel are those of the model plus uniform noise in +-0.01
    """

    model_file = "humanoid.xml"
    frames_per_step = 5
    height_index = 2
    unseen_positions = 2
    objectives = ("forward speed", "energy efficiency")
    camera: ClassVar = {"trackbodyid": 1, "distance": 4.0, "lookat": (0.0, 0.0, 2.0), "elevation": -20.0}
    deterministic = False
    reset_noise = 1e-2

    @property
    def is_healthy(self) -> bool:
        return bool(1.0 <= self.data.qpos[2] <= 2.0)

    def reset_model(self) -> np.ndarray:
        qpos = self.init_qpos + self.np_random.uniform(-self.reset_noise, self.reset_noise, self.model.nq)
        qvel = self.init_qvel + self.np_random.uniform(-self.reset_noise, self.reset_noise, self.model.nv)
        self.set_state(qpos, qvel)  # type: ignore[no-untyped-call]
        return self._observe()

    def _position(self) -> np.ndarray:
        """The mass centre."""
        mass = self.model.body_mass
        return (mass @ self.data.xipos / mass.sum())[:2]

    def _observe(self) -> np.ndarray:
        data = self.data
        forces = np.zeros(data.cfrc_ext.size) if self.physics == "2020" else data.cfrc_ext.ravel()
        return np.concatenate([super()._observe(), data.cinert.ravel(), data.cvel.ravel(), data.qfrc_actuator, forces])

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        return 1.25 * velocity[0] + 3, 3 - 4 * energy + 3


class MOSwimmer(PgmorlEnv):
    """A chain of three links swims along x.

    - objectives: forward speed v (m/s), energy efficiency 0.3 - 0.15 sum a^2
    - observation (8,): qpos without x and y, qvel
    - action (2,): the two joints, [-1, 1]
    - never terminates; truncated after 500 steps of 0.04 s
    - Gymnasium's swimmer.xml with gears of 300 (150 there) and without contacts, without reset noise
    """

    model_file = "swimmer.xml"
    frames_per_step = 4
    height_index = None
    unseen_positions = 2
    objectives = ("forward speed", "energy efficiency")
    camera: ClassVar = {"distance": 4.0}

    @staticmethod
    def _edit(spec: mujoco.MjSpec) -> None:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        for actuator in spec.actuators:
            actuator.gear[0] = 300

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        return velocity[0], 0.3 - 0.15 * energy


class MOWalker2d(PgmorlEnv):
    """A planar body with two legs walks along x.

    - objectives: forward speed v + 1 (m/s), energy efficiency 4 - sum a^2 + 1
    - observation (17,): qpos without x, qvel clipped to +-10
    - action (6,): thighs, legs and feet, [-1, 1]
    - terminates when z leaves (0.8, 2.0) or the torso's angle reaches 1 rad; truncated after 500 steps of 0.008 s
    - Gymnasium's walker2d.xml (frictions of 0.9 and 1.9 at the feet, other than in walker2d_v5.xml) with a density of 1500
      (1000 there) and joints damped by 3 (0.1 there), without reset noise
    """

    model_file = "walker2d.xml"
    frames_per_step = 4
    largest_velocity = 10.0
    objectives = ("forward speed", "energy efficiency")
    camera: ClassVar = {"trackbodyid": 2, "distance": 4.0, "lookat": (0.0, 0.0, 1.15), "elevation": -20.0}

    @staticmethod
    def _edit(spec: mujoco.MjSpec) -> None:
        for geom in spec.geoms:
            geom.density = 1500
        for joint in driven_joints(spec):
            set_damping(joint, 3)

    @property
    def is_healthy(self) -> bool:
        z, angle = self.data.qpos[1:3]
        return bool(0.8 < z < 2.0 and abs(angle) < 1)

    def _rewards(self, velocity: np.ndarray, energy: float) -> tuple[float, ...]:
        return velocity[0] + 1, 4 - energy + 1
