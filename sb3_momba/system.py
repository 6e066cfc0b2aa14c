"""What a result depends on beside its settings: versions of libraries, the machine, the git revision."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil
import torch as th

LIBRARIES = ("stable_baselines3", "torch", "numpy", "gymnasium", "mujoco", "mo-gymnasium", "moocore")
FAST_PRODUCTS = ("amx_bf16", "avx512_bf16", "avx512f", "avx2")


def library_versions() -> dict[str, str]:
    """Versions of Python, this package and the libraries whose numbers a result carries."""
    from sb3_momba import __version__

    versions = {"python": platform.python_version(), "sb3_momba": __version__}
    for library in LIBRARIES:
        try:
            versions[library] = version(library)
        except PackageNotFoundError:
            continue
    return versions


def machine() -> dict[str, Any]:
    """The hardware as a reader of a timing needs it; nothing that names the computer."""
    model, flags = _processor()
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": model,
        "instructions": [flag for flag in FAST_PRODUCTS if flag in flags],
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "torch_threads": th.get_num_threads(),
        "cuda": th.cuda.get_device_name(0) if th.cuda.is_available() else None,
    }


def git_revision() -> str | None:
    """The commit of this package's source, "-dirty" appended where a tracked file differs; None outside its repository."""
    here = Path(__file__)
    git = ["git", "-C", str(here.parent)]
    try:
        subprocess.run([*git, "ls-files", "--error-unmatch", here.name], check=True, capture_output=True, timeout=10)
        revision = subprocess.run(
            [*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            check=True,
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return revision.stdout.strip()


def _processor() -> tuple[str, set[str]]:
    """Name and instruction sets, as far as the system tells them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor(), set()
    entries = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    return entries.get("model name", platform.processor()), set(entries.get("flags", "").split())
