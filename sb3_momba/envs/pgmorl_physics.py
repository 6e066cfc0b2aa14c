"""MuJoCo models whose bodies and contacts follow the rules of 2020 or those of the installed release.

The published fronts of these tasks come from the MuJoCo of 2020, where two rules differed from today's: the mass and inertia
of capsules, and the margin at which two geoms touch. Together they move hypervolumes by up to 4 %.
"""

import numpy as np

from sb3_momba.envs.simulator import mujoco

PHYSICS = ("2020", "current")

INERTIAL_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat")


def check_physics(physics: str | int) -> None:
    """
    :raises ValueError: where physics is not one of PHYSICS
    """
    if str(physics) not in PHYSICS:
        raise ValueError(
            f"physics={physics!r} is not known: '2020' keeps the rules under which the published fronts were made, 'current' "
            "takes those of the installed MuJoCo."
        )


def compile_model(spec: mujoco.MjSpec, physics: str) -> mujoco.MjModel:
    """The model of a spec, which is left as it is.

    :param physics: "2020": capsules have the inertia of `with_cylinder_inertia`, and two geoms touch at the larger of their
        margins, not at their sum; "current": as the installed MuJoCo compiles it
    """
    check_physics(physics)
    model = _compile(spec)
    if physics == "2020":
        cylinders = _compile(with_cylinder_inertia(spec))
        for field in INERTIAL_FIELDS:
            getattr(model, field)[:] = getattr(cylinders, field)
        _set_constants(model)
        if sums_margins():
            # All margins of a model are equal here, so that half of them summed are the larger of two.
            model.geom_margin *= 0.5
    return model


def with_cylinder_inertia(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """A copy with every capsule of radius r and half-length h a cylinder of radius r and half-length h + r/2: as MuJoCo
    computed a capsule's inertia before 2.1.2."""
    spec = spec.copy()
    for geom in spec.geoms:
        if geom.type != mujoco.mjtGeom.mjGEOM_CAPSULE:
            continue
        geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        radius = geom.size[0]
        start, end = np.split(np.array(geom.fromto), 2)
        if np.isnan(start).any():
            geom.size = [radius, geom.size[1] + radius / 2, 0]
        else:
            cap = (end - start) / np.linalg.norm(end - start) * radius / 2
            geom.fromto = np.concatenate([start - cap, end + cap])
    return spec


def sums_margins() -> bool:
    """Whether the installed MuJoCo adds the margins of two geoms (since 3.5.0), or takes the larger one."""
    major, minor = mujoco.__version__.split(".")[:2]
    return (int(major), int(minor)) >= (3, 5)


def driven_joints(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    """The joints with a motor."""
    names = {actuator.target for actuator in spec.actuators}
    return [joint for joint in spec.joints if joint.name in names]


def set_damping(joint: mujoco.MjsJoint, damping: float) -> None:
    """Linear damping, a number in MuJoCo 3 and the first coefficient of a polynomial in later releases."""
    joint.damping = damping if np.ndim(joint.damping) == 0 else [damping, *np.zeros(len(joint.damping) - 1)]


def _compile(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """`spec.compile()` with a total mass set as MuJoCo 4 asks for it, which warns of the compiler's `settotalmass`."""
    spec = spec.copy()
    total_mass = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1
    model = spec.compile()
    if total_mass > 0:
        mujoco.mj_setTotalmass(model, total_mass)
        _set_constants(model)
    return model


def _set_constants(model: mujoco.MjModel) -> None:
    """What the compiler derives from masses and inertias."""
    mujoco.mj_setConst(model, mujoco.MjData(model))
    # MuJoCo 3 sets these in mj_setConst, 4 only in the compiler; the solver's tolerance depends on the first.
    model.stat.meaninertia = model.dof_M0.mean()
    model.stat.meanmass = model.body_mass[1:].mean()
