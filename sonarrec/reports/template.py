"""Fills the template of a page: values are escaped, and its script is allowed by its hash."""

from __future__ import annotations

import hashlib
import json
from base64 import b64encode
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def fill(template: str, scripts: tuple[str, ...], data: Any, **values: Any) -> str:
    """A template of this folder as HTML. scripts: files that make up `script`. data: what they
    read, as the JSON `data`."""
    folder = files("sonarrec.reports")
    script = "".join((folder / name).read_text(encoding="utf-8") for name in scripts)
    environment = Environment(
        loader=PackageLoader("sonarrec.reports", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return environment.get_template(template).render(
        **values,
        data=text.replace("<", "\\u003c"),  # safe inside a script element
        script=script,
        script_hash=b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )
