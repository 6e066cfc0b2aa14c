"""Which runs are runs of one method: those of one label and the same settings."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from sb3_momba.records import Record
from sb3_momba.zoo.configuration import with_later_settings

# Settings in which runs of one method may differ.
NOT_THE_METHOD = ("env", "env_kwargs", "seed", "label", "objectives", "reference_point", "device", "subprocesses", "eval_freq")


def name_methods(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Records by their label; where those of one label differ in settings, the differing ones are appended to the name."""
    by_label: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        by_label[record.label].append(record)
    methods: dict[str, list[Record]] = defaultdict(list)
    for label in sorted(by_label):
        settings = [method_settings(record) for record in by_label[label]]
        names = differing(settings)
        for record, one in zip(by_label[label], settings, strict=True):
            suffix = ", ".join(f"{name.split('.')[-1]}={setting_text(one.get(name))}" for name in names)
            methods[f"{label} ({suffix})" if suffix else label].append(record)
    return dict(methods)


def differing(settings: Sequence[dict[str, Any]]) -> list[str]:
    """The names under which several flat settings do not have the same."""
    names = sorted({name for one in settings for name in one})
    return [name for name in names if len({repr(one.get(name)) for one in settings}) > 1]


def method_settings(record: Record) -> dict[str, Any]:
    """The settings in which two runs of one method must not differ, flat."""
    return flat({k: v for k, v in with_later_settings(record.config).items() if k not in NOT_THE_METHOD})


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} -> {"a.b": 1.0}: 1 and 1.0 are the same setting, in lists too."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            found.update(flat(value, f"{prefix}{name}."))
        else:
            found[f"{prefix}{name}"] = _with_floats(value)
    return found


def _with_floats(value: Any) -> Any:
    if isinstance(value, list):
        return [_with_floats(one) for one in value]
    return float(value) if type(value) is int else value


def setting_text(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(setting_text, value))}]"
    return f"{value:.12g}" if isinstance(value, float) else str(value)
