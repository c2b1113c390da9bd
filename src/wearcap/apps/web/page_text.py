"""Text on the pages. viser renders HTML as it is, and markdown with the HTML in it: texts of files and devices are escaped here.

viser itself shows labels, folders, buttons, options, fields and notifications as text; no page uses its markdown.
"""

from html import escape

MAX_NAME, MAX_TEXT = 40, 300
"""Longest name and longest other text (characters) that are shown: they come from files and from the network."""


def fitting(text: str, most: int = MAX_NAME) -> str:
    """At most so many characters of a text, in one line, for what viser shows as text."""
    plain = "".join(one for one in " ".join(text[: 4 * most].split()) if one.isprintable()).strip()
    return plain if len(plain) <= most else f"{plain[: most - 1]}…"


def escaped(text: str, most: int = MAX_TEXT) -> str:
    """The same for HTML: a reader sees it as it was written."""
    return escape(fitting(text, most))


def block(html: str) -> str:
    """A block of a page's panel, of HTML whose texts are `escaped`."""
    return f'<div style="padding:2px 12px 6px;font-size:14px;overflow-wrap:anywhere">{html}</div>'
