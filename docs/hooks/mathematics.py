"""TeX formulas, which the notebooks have, as MathML: browsers draw it without a script."""

import html
import re

from latex2mathml.converter import convert

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([\[(])(.*?)\\[\])]</\1>', re.S)


def on_page_content(content, **_):
    """Replace what pymdownx.arithmatex has marked."""
    return FORMULA.sub(_mathml, content)


def _mathml(found):
    tag, bracket, tex = found.groups()
    display = "block" if bracket == "[" else "inline"
    tex, _, number = html.unescape(tex).partition(r"\tag{")
    made = convert(tex.strip(), display=display)
    return f'<{tag} class="formula">{made}{_number(number)}</{tag}>'


def _number(text):
    return f'<span class="number">({text.strip().rstrip("}")})</span>' if text else ""
