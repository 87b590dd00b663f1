"""Whether a run that is there was made with the settings that it would have now."""

from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

ELSEWHERE = ("out", "cache", "quiet", "report")  # say where results go and what is told, not what they are


def difference(run: Path, config: DictConfig) -> str:
    """The first option that differs, with both values; empty where none does or the run did not keep its options."""
    path = run / ".hydra" / "config.yaml"
    if not path.is_file():
        return ""
    before = _flat(OmegaConf.to_container(OmegaConf.load(path)))
    now = _flat(yaml.safe_load(OmegaConf.to_yaml(OmegaConf.masked_copy(config, _keys(config)))))
    for name in sorted(before.keys() | now.keys()):
        if name not in ELSEWHERE and before.get(name, "not there") != now.get(name, "not there"):
            return f"{name} was {_said(before, name)} and is {_said(now, name)} now"
    return ""


def _keys(config: DictConfig) -> list[str]:
    return [str(key) for key in config if key not in ("hydra", "out")]


def _flat(values: Any, path: str = "") -> dict[str, Any]:
    if not isinstance(values, dict) or not values:
        return {path: values}
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{path}.{key}" if path else str(key))
    return flat


def _said(values: dict[str, Any], name: str) -> str:
    return str(values[name]) if name in values else "not there"
