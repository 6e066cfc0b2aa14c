"""Pictures of MuJoCo's bodies, drawn without a window and without touching what is simulated."""

import copy
import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_momba.envs.simulator import mujoco

Image = NDArray[np.uint8]

MAX_GEOMS = 10_000
FADED = 0.09  # how much of its contrast the floor keeps: bodies stand out, and films are smaller


class RenderingError(Exception):
    """Nothing can be drawn; the message says why, and what to do."""


def backends() -> tuple[str, ...]:
    """Which of OpenGL's ways to draw without a window to try, by MuJoCo's names: the user's MUJOCO_GL, or all there are.

    :raises RenderingError: where MUJOCO_GL switches drawing off, or is no name
    """
    every = ("egl", "osmesa") if sys.platform == "linux" else ("cgl",) if sys.platform == "darwin" else ("glfw",)
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in ("", "1", "on", "true", "enable", "enabled"):
        return every
    if wanted not in (*every, "glfw"):
        raise RenderingError(
            f"the environment variable MUJOCO_GL is {wanted!r}: leave it out, or set it to {' or '.join(every)}."
        )
    return (wanted,)


@dataclass
class Camera:
    """Where a free camera looks, in metres and degrees; it looks along y, so that x goes to the right."""

    lookat: NDArray[np.float64]
    distance: float
    elevation: float

    def to_mujoco(self) -> Any:
        """As `mujoco.MjvCamera`."""
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = self.lookat
        camera.distance, camera.elevation, camera.azimuth = self.distance, self.elevation, 90.0
        return camera


class Stage:
    """Draws states of one model into images of one size, on a light floor that goes on for ever.

    :param model: `mujoco.MjModel`; a copy of it is changed
    :param backend: OpenGL's way to draw without a window, "egl", "osmesa", "glfw" or "cgl"
    :param fine: smooth edges and shadows, at ten times the work where a processor draws
    """

    def __init__(self, model: Any, width: int, height: int, backend: str, fine: bool = False):
        self.model = model = copy.copy(model)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = 4 if fine else 0
        _lighten(model)
        self.context = _gl_context(backend, width, height)
        self.context.make_current()
        self.drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.drawing)
        self.scene = mujoco.MjvScene(model, MAX_GEOMS)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = fine
        self.viewport = mujoco.MjrRect(0, 0, width, height)
        self.options, self.perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()

    def image(self, data: Any, camera: Camera, earlier: Sequence[tuple[Any, float]] = ()) -> Image:
        """
        :param data: `mujoco.MjData` of the body
        :param earlier: more poses of it, each with its opacity in [0, 1]
        :return: (height, width, 3)
        """
        self.context.make_current()  # Another stage may have been drawn on since.
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, data, self.options, self.perturbation, camera.to_mujoco(), everything, self.scene)
        for pose, opacity in earlier:
            first = self.scene.ngeom
            moving = mujoco.mjtCatBit.mjCAT_DYNAMIC
            mujoco.mjv_addGeoms(self.model, pose, self.options, self.perturbation, moving, self.scene)
            for geom in self.scene.geoms[first : self.scene.ngeom]:
                geom.rgba[3] = opacity
        mujoco.mjr_render(self.viewport, self.scene, self.drawing)
        image = np.zeros((self.viewport.height, self.viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(image, None, self.viewport, self.drawing)
        return image[::-1]

    def close(self) -> None:
        """Give OpenGL's memory back."""
        self.drawing.free()
        self.context.free()


def body_box(model: Any, data: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The corners of a box around the moving bodies, each (3,), in metres."""
    moving = model.geom_bodyid > 0
    radius = model.geom_rbound[moving, None]
    return (data.geom_xpos[moving] - radius).min(axis=0), (data.geom_xpos[moving] + radius).max(axis=0)


def camera_on(model: Any, data: Any) -> Camera:
    """A camera that shows the whole body as it is now: from its side, or from above if it is flat."""
    low, high = body_box(model, data)
    _, y, z = np.ptp(data.geom_xpos[model.geom_bodyid > 0], axis=0)
    is_flat = z < 0.75 * y or z == 0
    return Camera((low + high) / 2, 1.75 * float((high - low).max()), -40.0 if is_flat else -12.0)


def follow(camera: Camera, data: Any) -> Camera:
    """The camera moved along the floor to where the mass centre is; its height stays, so that jumps are seen."""
    centre = data.subtree_com[0]
    return Camera(np.array([centre[0], centre[1], camera.lookat[2]]), camera.distance, camera.elevation)


def _gl_context(backend: str, width: int, height: int) -> Any:
    try:
        return importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
    except Exception as error:  # Each library fails in its own way.
        raise RenderingError(f"{backend}: {type(error).__name__}: {str(error).strip() or 'no reason given'}") from error


def _lighten(model: Any) -> None:
    """Floors without an end and in pale grey, a pale sky, and lights under which neither is white nor a shadow black."""
    light = model.vis.headlight
    light.ambient[:], light.diffuse[:], light.specular[:] = 0.5, 0.35, 0
    model.light_ambient[:], model.light_diffuse[:], model.light_specular[:] = 0, 0.35, 0.1
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_size[planes, :2] = 0
    model.geom_rgba[planes, :3] = 1
    for material in set(model.geom_matid[planes].tolist()) - {-1}:
        model.mat_rgba[material, :3] = 1
        model.mat_reflectance[material] = model.mat_specular[material] = 0
        model.mat_texuniform[material], model.mat_texrepeat[material] = True, 1  # squares of half a metre
        for texture in set(np.ravel(model.mat_texid[material]).tolist()) - {-1}:
            _fade(model, texture)
    for texture in np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
        _texels(model, int(texture))[:] = 250


def _fade(model: Any, texture: int) -> None:
    texels = _texels(model, texture)
    grey = texels.mean(axis=1, keepdims=True)
    span = max(float(np.ptp(grey)), 1.0)
    texels[:] = np.round(255 * (0.98 - FADED * (1 - (grey - grey.min()) / span)))


def _texels(model: Any, texture: int) -> Any:
    """A view of a texture's pixels, (n, channels)."""
    channels = int(model.tex_nchannel[texture])
    start = int(model.tex_adr[texture])
    n = int(model.tex_height[texture]) * int(model.tex_width[texture])
    return model.tex_data[start : start + n * channels].reshape(n, channels)
