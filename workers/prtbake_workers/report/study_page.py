"""A study as pages: one that a reader points at, and one that runs nothing."""

import base64
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from prtbake_storage.plots import FRONTIER_SCRIPT
from prtbake_workers.report.html import ENVIRONMENT

STYLE = """
:root { color-scheme: light dark; font: 15px/1.5 system-ui, sans-serif; }
body { max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2.2rem; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: .3rem .7rem .3rem 0; vertical-align: top; }
th, td { border-bottom: 1px solid #8884; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.wide { overflow-x: auto; } .note { color: #888; font-size: .9rem; }
#plot button { margin-right: .5rem; } #plot button[aria-pressed=true] { font-weight: 600; }
img { max-width: 100%; }
#plot ul { list-style: none; padding: 0; min-height: 9em; }
"""
_DRAW = """
drawFrontier(
  document.getElementById("plot"), JSON.parse(document.getElementById("study").textContent));
"""


def study_page(study: Mapping[str, Any], picture: bytes | None = None) -> str:
    """Render a study (see :mod:`prtbake_workers.jobs.study_report`).

    The page fetches nothing.  With a PNG ``picture`` it runs nothing either; without, one script
    draws the plot, and the page's policy names it by its digest and lets no other run.
    """
    script, embedded = "", None
    if picture is None:
        script = FRONTIER_SCRIPT.read_text(encoding="utf-8") + _DRAW
    else:
        embedded = "data:image/png;base64," + base64.b64encode(picture).decode("ascii")
    policy = "; ".join(
        (
            "default-src 'none'",
            f"script-src {_digest(script)}" if script else "script-src 'none'",
            f"style-src {_digest(STYLE)}",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        )
    )
    # inside a script element only its end tag, or what opens a comment, could end the data
    data = json.dumps(study, allow_nan=False).replace("<", "\\u003c")
    return ENVIRONMENT.get_template("study.html").render(
        study=study,
        picture=embedded,
        policy=Markup(policy),
        style=Markup(STYLE),
        script=Markup(script),
        data=Markup(data),
    )


def _digest(text: str) -> str:
    raw = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(raw).decode('ascii')}'"
