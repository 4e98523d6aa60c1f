"""Types of options whose help says itself what happens without them, so that no default is shown after it."""

from __future__ import annotations

from typing import Annotated, TypeVar

import tyro

_T = TypeVar("_T")
_UNSAID = tyro.conf.arg(help_behavior_hint="")

Maybe = Annotated[_T | None, _UNSAID]
"""A value, by default none."""
Several = Annotated[tuple[_T, ...], _UNSAID]
"""Values, by default none."""
Repeated = Annotated[tuple[_T, ...], _UNSAID, tyro.conf.UseAppendAction]
"""Values, one for each time that the option is given; by default none."""
Word = Annotated[str, _UNSAID]
"""A text, by default empty."""
