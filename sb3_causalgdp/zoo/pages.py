"""Pages about runs as HTML: everything that a run says is text in them, and nothing of it is run."""

from collections.abc import Sequence
from pathlib import Path

import jinja2

from sb3_causalgdp.zoo.parts import Section

_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def style() -> str:
    """
    :return: The style sheet of all pages
    """
    return Path(__file__).with_name("page.css").read_text(encoding="utf-8")


def report_page(title: str, sections: Sequence[Section]) -> str:
    """
    :param title: Of the page
    :param sections: What stands on it
    :return: The page, which loads nothing
    """
    return _TEMPLATES.get_template("report.html").render(title=title, sections=sections)


def section_html(section: Section) -> str:
    """
    :param section: A part of a page
    :return: Its HTML
    """
    return str(_TEMPLATES.get_template("section.html").module.show_section(section))  # type: ignore[attr-defined]
