"""What all sections of a campaign share: kinds of values, and how a rule between several of them is broken."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
SURROGATE_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"
LARGEST_EXACT_WHOLE_FLOAT = 2.0**53


def whole(value: Any) -> Any:
    """Turn ``1e6`` into ``1000000``: YAML reads every number with an exponent as a float."""
    if isinstance(value, float) and value.is_integer() and abs(value) <= LARGEST_EXACT_WHOLE_FLOAT:
        return int(value)
    return value


Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
Whole = Annotated[int, BeforeValidator(whole)]
SurrogateName = Annotated[str, Field(pattern=SURROGATE_PATTERN)]


def broken_rule(key: str, *, found: str, expected: str, mend: str) -> PydanticCustomError:
    """Error for a rule between several values, in the parts of a `harness.errors.HarnessError`.

    ``key`` is the dotted path of the value to blame, seen from the section that states the rule; empty for the section.
    """
    parts = {"key": key, "found": found, "expected": expected, "mend": mend}
    where = "{key}: " if key else ""
    return PydanticCustomError("broken_rule", where + "found {found}; expected {expected}. {mend}", parts)


class Section(BaseModel):
    """A section of the campaign: unknown keys are errors, values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def replaced(self, path: Sequence[str], value: Any) -> Self:
        """A copy with another value at a path such as ``("av", "fmu", "file")``, not validated."""
        key, *rest = path
        return self.model_copy(update={key: getattr(self, key).replaced(rest, value) if rest else value})


def _whole_steps(seconds: float) -> float:
    """Refuse a time that is not a multiple of the 0.1 s step."""
    steps = seconds * 10.0
    if abs(steps - round(steps)) >= 1e-9:
        raise broken_rule(
            "",
            found=f"{seconds:g} s",
            expected="a multiple of the 0.1 s step",
            mend=f"The nearest one is {round(steps) / 10.0:g}.",
        )
    return seconds


StepTime = Annotated[float, AfterValidator(_whole_steps)]
LeadTime = Annotated[float, Field(ge=0.0, le=10.0), AfterValidator(_whole_steps)]
"""Between the onset of a lane change and overlap."""


def listed(names: Iterable[str]) -> str:
    """Names in a message."""
    return ", ".join(names) or "none"
