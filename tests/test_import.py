"""The core: quick to import, and without any of the extras."""

import json
import resource
import subprocess
import sys

SCRIPT = """
import importlib.metadata as metadata, json, re, sys

def needed(name, known):
    if name in known:
        return
    known.add(name)
    try:
        requirements = metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return
    for requirement in requirements:
        wanted, _, marker = requirement.partition(";")
        if "extra" not in marker:
            needed(normal(re.match(r"[\\w.-]+", wanted)[0]), known)

def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()

known = set()
needed("sb3-momba", known)
known |= {"mujoco", "imageio", "setuptools", "pip"}  # of gymnasium[mujoco], and of every environment

class OnlyTheCore:
    def find_spec(self, name, path=None, target=None):
        owners = {normal(one) for one in owned.get(name.partition(".")[0], [])}
        if owners and not owners & known:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

owned = metadata.packages_distributions()
sys.meta_path.insert(0, OnlyTheCore())
import sb3_momba
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def test_the_core_needs_no_extra() -> None:
    modules = json.loads(subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True).stdout)
    assert "sb3_momba" in modules
    extras = {"rl_zoo3", "optuna", "wandb", "onnx", "huggingface_hub", "pymoo", "morl_baselines", "plotly", "imageio_ffmpeg"}
    assert not {"matplotlib", "mujoco", *extras} & set(modules)


def test_the_core_is_imported_in_three_seconds() -> None:
    """Of processor time, the least of three: what else runs only adds to it."""
    assert min(seconds_to_import() for _ in range(3)) < 3


def seconds_to_import() -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", "import sb3_momba"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
