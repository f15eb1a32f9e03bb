"""Which faults strike, when and how strongly: a YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError, model_validator

from netpos.common.parameters import FaultsError, nearest
from netpos.common.yaml_text import YamlError, load_yaml
from netpos.evaluation.faults.table import FAULTS
from netpos.scenario.section import Finite, Positive, Section

DEFAULT = Path(__file__).with_name("default.yaml")


class PlanError(FaultsError):
    """A plan that cannot be used; the text names file, fault and remedy."""


class Entry(Section):
    """One fault. ``rsus``: how many RSUs, those heard most often meanwhile, or ``all``; ``start``:
    share of the run that has passed; ``size``: in the unit of the fault."""

    fault: str
    size: Finite = 0.0
    rsus: int | Literal["all"] = Field(default=1)
    start: float | None = Field(default=None, ge=0.0, lt=1.0)
    lasts_s: Positive | None = None

    @property
    def name(self) -> str:
        """The fault, its size and its RSUs, in words."""
        unit = FAULTS[self.fault].unit
        size = f" {self.size:g} {unit}" if unit else ""
        number = "" if self.rsus == 1 else f", {self.rsus} RSUs"
        return f"{self.fault}{size}{number}"


class Plan(Section):
    """Faults that strike one by one, each in a run of its own, all from ``start`` (a share of the
    run) for ``lasts_s``, unless they say otherwise."""

    seed: int = Field(default=1, ge=0)
    start: float = Field(default=0.4, ge=0.0, lt=1.0)
    lasts_s: Positive = 10.0
    faults: tuple[Entry, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _known(self) -> Plan:
        for entry in self.faults:
            if entry.fault not in FAULTS:
                close = nearest(entry.fault, FAULTS)
                raise ValueError(f"no fault {entry.fault!r}{close}; known: {', '.join(FAULTS)}")
            if FAULTS[entry.fault].unit and not entry.size:
                unit = FAULTS[entry.fault].unit
                raise ValueError(f"{entry.fault} needs a size [{unit}]")
            if not FAULTS[entry.fault].unit and entry.size:
                raise ValueError(f"{entry.fault} has no size; leave it out")
            if FAULTS[entry.fault].unit == "share" and not 0.0 < entry.size <= 1.0:
                raise ValueError(f"size of {entry.fault} is a share, 0 to 1, got {entry.size:g}")
            if entry.rsus != "all" and entry.rsus < 1:
                raise ValueError(f"rsus of {entry.fault} must be >= 1 or all, got {entry.rsus}")
        return self


def load_plan(path: Path | str = DEFAULT) -> Plan:
    """Read a plan. Raises ``PlanError`` with the file, or ``OSError``."""
    try:
        content = load_yaml(Path(path).read_text(encoding="utf-8"))
        return Plan.model_validate(content)
    except (YamlError, UnicodeDecodeError) as error:
        raise PlanError(f"{path}: {error}") from error
    except ValidationError as error:
        lines = [
            f"{path}: {'.'.join(map(str, e['loc']))}{': ' if e['loc'] else ''}"
            f"{e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        ]
        raise PlanError("\n".join(lines)) from error
