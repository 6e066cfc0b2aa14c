"""The package's metadata; tools are configured in pyproject.toml."""

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
VERSION = re.search(r'__version__ = "(.+)"', (ROOT / "sb3_momba" / "__init__.py").read_text()).group(1)

setup(
    name="sb3-momba",
    version=VERSION,
    description="Multi-objective reinforcement learning for Stable-Baselines3: one run learns the whole Pareto front",
    long_description=(ROOT / "README.md").read_text(),
    long_description_content_type="text/markdown",
    license="MIT",
    license_files=["LICENSE"],
    packages=find_packages(include=["sb3_momba", "sb3_momba.*"]),
    package_data={
        "sb3_momba": [
            "py.typed",
            "envs/riesz.npz",
            "zoo/hyperparams/*.yml",
            "benchmark/grids/*.yml",
            "benchmark/chapter4/thesis.yml",
            "explorer/page/*",
        ],
    },
    python_requires=">=3.10",
    install_requires=[
        "stable-baselines3>=2.9,<3",
        "torch>=2.8",
        "gymnasium[mujoco]>=1.1",
        "mujoco>=3.2",
        "mo-gymnasium>=1.3",
        "moocore>=0.3",
        "numpy>=1.26",
        "scipy>=1.11",
        "matplotlib>=3.8",
        "tensorboard>=2.15",
        "tqdm>=4.66",
        "rich>=13",
        "pyyaml>=6",
        "psutil>=5.9",
    ],
    extras_require={
        "baselines": ["morl-baselines>=1.3"],
        "benchmark": ["ray[tune]>=2.40"],  # sweeps; grids on one machine need nothing
        "docs": ["sphinx>=8", "myst-parser>=4", "furo>=2024.8"],
        "explorer": ["plotly>=6", "imageio-ffmpeg>=0.5", "onnx>=1.16"],  # the last one for policies that are kept
        "export": ["onnx>=1.16"],  # .onnx files; TorchScript needs nothing
        "hub": ["huggingface_hub>=0.30"],
        "zoo": ["rl_zoo3>=2.9,<3", "seaborn>=0.13", "pandas>=2.2,<3"],  # the last two for its plots
        "test": [
            "sb3-momba[baselines,benchmark,docs,explorer,export,hub,zoo]",
            "onnxruntime>=1.18",
            "playwright>=1.45",  # drives the system's Chromium
            "wandb>=0.19",
            "pymoo>=0.6",
            "rliable>=1.2",
            "pandas<3",  # rliable's bootstrap library fails with newer ones
            "pytest>=8",
            "pytest-xdist>=3.6",
            "hypothesis>=6.100",
            "ruff>=0.15",
            "mypy>=1.15",
            "types-PyYAML",
            "types-psutil",
        ],
    },
    classifiers=[
        "Intended Audience :: Science/Research",
        "Programming Language :: Python :: 3",
        "Topic :: Scientific/Engineering :: Artificial Intelligence",
        "Typing :: Typed",
    ],
)
