"""Fills the templates of the pages; all values are escaped."""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined


def filled(template: str, package: str = "sonarrec.report", /, **values: Any) -> str:
    """A template of a package filled with values, as HTML. It may include those of this folder."""
    return _environment(package).get_template(template).render(values)


@cache  # keeps the compiled templates
def _environment(package: str) -> Environment:
    return Environment(
        loader=ChoiceLoader([PackageLoader(p, ".") for p in (package, "sonarrec.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
