"""Fills the templates of the pages; all values are escaped."""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def filled(template: str, **values: Any) -> str:
    """A template of this folder filled with values, as HTML."""
    return _environment().get_template(template).render(values)


@cache  # keeps the compiled templates
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("sonarrec.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
