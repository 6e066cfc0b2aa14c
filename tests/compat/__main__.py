"""Stable-Baselines3's own tests with MOMBA in SAC's place: `python -m tests.compat`.

The tests come with the source distribution of the installed version, which pip downloads into `.compat`. They run twice: on
their own scalar environments, and with two objectives. What MOMBA refuses by design stands in refused.yml, with the reason; the
exit status is 1 if any other test fails, or if an entry of that list does not hold any more.
"""

import fnmatch
import json
import os
import subprocess
import sys
import tarfile
from collections import Counter
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import yaml

ROOT = Path(__file__).parent.parent.parent
REFUSED = Path(__file__).with_name("refused.yml")
FILES = (
    *("save_load", "run", "deterministic", "callbacks", "predict", "spaces", "identity", "tensorboard"),
    *("custom_policy", "train_eval_mode"),
)
OUTCOMES = ("passed", "refused", "failed", "skipped")


class Refusal(NamedTuple):
    """Tests whose failure is meant.

    :param tests: patterns of their names, in which * stands for anything
    :param error: part of the error that each must end with
    :param objectives: numbers of objectives of the runs in which this is so
    """

    tests: list[str]
    error: str
    reason: str
    objectives: list[int]


def refusals() -> list[Refusal]:
    return [Refusal(**{"objectives": [1, 2], **entry}) for entry in yaml.safe_load(REFUSED.read_text())]


def download(folder: Path) -> Path:
    """The folder with the tests of the installed version of Stable-Baselines3."""
    number = version("stable_baselines3")
    unpacked = folder / f"stable_baselines3-{number}"
    if not unpacked.is_dir():
        source = ["--no-deps", "--no-build-isolation", "--no-binary", "stable-baselines3", "--dest", str(folder)]
        pip = [sys.executable, "-m", "pip", "download", "--quiet", *source, f"stable-baselines3=={number}"]
        subprocess.run(pip, check=True)
        with tarfile.open(f"{unpacked}.tar.gz") as archive:
            # Only these: the package itself is to be the one that is installed.
            names = (f"{unpacked.name}/tests/", f"{unpacked.name}/pyproject.toml")
            archive.extractall(folder, [one for one in archive if one.name.startswith(names)], filter="data")
    return unpacked


def run(folder: Path, objectives: int) -> dict[str, dict[str, Any]]:
    """Of each test its outcome, its error, and whether it had two objectives."""
    results = folder / f"{objectives}.json"
    results.unlink(missing_ok=True)
    options = ["-p", "tests.compat.plugin", "-p", "no:cacheprovider", "-q", "--tb=no", "--no-summary"]
    files = [f"tests/test_{name}.py" for name in FILES]
    command = [sys.executable, "-m", "pytest", *options, f"--objectives={objectives}", f"--results={results}", *files]
    subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    return json.loads(results.read_text())  # type: ignore[no-any-return]


def judge(results: dict[str, dict[str, Any]], refused: list[Refusal]) -> list[str]:
    """Call the failures that are meant "refused", in `results`; what is wrong with tests or list, one line each."""
    wrong = []
    for refusal in refused:
        for pattern in refusal.tests:
            covered = fnmatch.filter(results, pattern.replace("[", "[[]"))
            if not covered:
                wrong.append(f"refused.yml: no test is called {pattern}")
            for test in covered:
                if results[test]["outcome"] == "passed":
                    wrong.append(f"refused.yml: {test} passes, though it stands there")
                elif results[test]["outcome"] == "failed" and refusal.error in results[test]["error"]:
                    results[test]["outcome"] = "refused"
    failed = [f"{test}: {result['error']}" for test, result in results.items() if result["outcome"] == "failed"]
    return wrong + failed


def table(results: dict[str, dict[str, Any]]) -> str:
    """Outcomes for each file and in total, as Markdown."""
    lines = [f"| File | {' | '.join(OUTCOMES)} |", f"|---|{'---:|' * len(OUTCOMES)}"]
    for file in [*dict.fromkeys(test.split("::")[0] for test in results), ""]:
        counts = Counter(result["outcome"] for test, result in results.items() if test.startswith(file))
        lines.append(f"| {file or 'all'} | {' | '.join(str(counts[outcome]) for outcome in OUTCOMES)} |")
    return "\n".join(lines)


def main() -> None:
    folder = ROOT / ".compat"
    folder.mkdir(exist_ok=True)
    tests, known = download(folder), refusals()
    tables, wrong = [], []
    for objectives, title in ((1, "One objective"), (2, "Two objectives")):
        results = run(tests, objectives)
        complaints = judge(results, [refusal for refusal in known if objectives in refusal.objectives])
        wrong += [f"{title}: {complaint}" for complaint in complaints]
        with_two = sum(result["two_objectives"] for result in results.values() if result["outcome"] == "passed")
        missing = [name for name in FILES if not any(test.startswith(f"test_{name}.py") for test in results)]
        wrong += [f"{title}: no test of {name} uses SAC any more" for name in missing]
        if objectives == 2 and with_two == 0:
            wrong.append(f"{title}: no test had two")
        note = f"\n\n{with_two} of the tests that passed had two objectives." if objectives == 2 else ""
        tables.append(f"{title}\n\n{table(results)}{note}")
    reasons = [f"- {refusal.reason}" for refusal in known]
    print("\n\n".join([*tables, "\n".join(["Refused by design:", *reasons]), "\n".join(wrong) or "Nothing else fails."]))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
