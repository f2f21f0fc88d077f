"""Tables from the models, and formulas as MathML, which browsers draw without a script."""

import html
import re

from latex2mathml.converter import convert
from settings_tables import with_tables

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put tables where a page asks for them."""
    return with_tables(markdown)


def on_page_content(content: str, **_: object) -> str:
    """Replace every formula that the Markdown extension marked."""

    def mathml(found: re.Match[str]) -> str:
        display = "block" if found[2] == "[" else "inline"
        return convert(html.unescape(found[3]), display=display)

    return FORMULA.sub(mathml, content)
