"""Pages of one file in the report's style: cards, tables, legends and pictures; no scripts, no network."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from functools import cache
from importlib import resources

import cv2
from markupsafe import Markup, escape

from rigwake import __version__
from rigwake._types import Image
from rigwake.report.charts import COLOURS

CLOCKS_ARE_SET_NS = 946_684_800_000_000_000
"""2000: stamps before it count from the start of some computer and are no dates."""
_WIDTH_PX, _QUALITY = 640, 78
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@cache
def style_sheet() -> str:
    """The CSS of the report."""
    return resources.files("rigwake.report").joinpath("assets", "report.css").read_text(encoding="utf-8")


def html_page(title: str, parts: Iterable[Markup], lead: str = "", style: str = "") -> str:
    """A whole page. parts: cards and the like, one below the other; lead: one sentence under the title; style: CSS
    beside the report's. Text that is not Markup is escaped."""
    # an empty icon, or the browser asks for one
    head = Markup(
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="{policy}"><title>{title}</title>'
        '<link rel="icon" href="data:,"><style>{css}</style>'
    ).format(policy=_POLICY, title=title, css=Markup(style_sheet() + style))
    words = Markup('<p class="muted">{}</p>').format(lead) if lead else Markup("")
    body = Markup("").join(parts)
    return Markup(
        '<!doctype html><html lang="en"><head>{head}</head><body><header><h1>{title}</h1>{words}</header>'
        "<main>{body}</main><footer>rigwake {version}. This page needs no network.</footer></body></html>"
    ).format(head=head, title=title, words=words, body=body, version=__version__)


def card(title: str, *parts: Markup | str) -> Markup:
    """A titled card; empty without parts."""
    inside = Markup("").join(escape(part) for part in parts)
    return (
        Markup('<section class="card"><h2>{}</h2>{}</section>').format(title, inside)
        if inside
        else Markup("")
    )


def table(
    title: str, head: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[int] = ()
) -> Markup:
    """A table that scrolls by itself where the screen is narrow. title: for those who cannot see it; words: columns of
    text, set to the left and wrapped."""
    if not rows:
        return Markup("")

    def line(cells: Sequence[str], tag: str) -> Markup:
        inside = Markup("").join(
            Markup("<{tag}{css}>{cell}</{tag}>").format(
                tag=Markup(tag), css=Markup(' class="words"') if i in words else "", cell=cell
            )
            for i, cell in enumerate(cells)
        )
        return Markup("<tr>{}</tr>").format(inside)

    body = Markup("").join(line(row, "td") for row in rows)
    return Markup(
        '<div class="scroll" tabindex="0" role="region" aria-label="{title}"><table><thead>{head}</thead>'
        "<tbody>{body}</tbody></table></div>"
    ).format(title=title, head=line(head, "th") if any(head) else "", body=body)


def note(text: str) -> Markup:
    """A sentence in small print."""
    return Markup('<p class="note">{}</p>').format(text)


def listing(lines: Iterable[str]) -> Markup:
    """A list of sentences; empty without any."""
    inside = Markup("").join(Markup("<li>{}</li>").format(line) for line in lines)
    return Markup("<ul>{}</ul>").format(inside) if inside else inside


def verdict(tone: str, word: str, sentences: Iterable[str]) -> Markup:
    """The box that says first what came out. tone: `good`, `usable` or `lost`."""
    said = Markup("").join(Markup("<p>{}</p>").format(s) for s in sentences)
    return Markup('<div class="verdict {}"><strong>{}</strong>{}</div>').format(tone, word, said)


def legend(names: Iterable[str]) -> Markup:
    """Names with the colours of the palette, in order."""
    items = Markup("").join(
        Markup('<li><span class="swatch s{}" aria-hidden="true"></span>{}</li>').format(index % COLOURS, name)
        for index, name in enumerate(names)
    )
    return Markup('<ul class="legend">{}</ul>').format(items)


def figure(chart: Markup, caption: str) -> Markup:
    """A chart with its caption; empty without a chart."""
    return Markup("<figure>{}<figcaption>{}</figcaption></figure>").format(chart, caption) if chart else chart


def side_by_side(*figures: Markup) -> Markup:
    """Figures beside each other where the screen is wide."""
    drawn = [f for f in figures if f]
    return Markup('<div class="pair">{}</div>').format(Markup("").join(drawn)) if drawn else Markup("")


def grid(*figures: Markup) -> Markup:
    """Small figures in as many columns as fit."""
    drawn = [f for f in figures if f]
    return Markup('<div class="grid">{}</div>').format(Markup("").join(drawn)) if drawn else Markup("")


def picture(image: Image, words: str, overlay: Iterable[str] = ()) -> Markup:
    """An image (H, W[, 3]) inside the page, reduced, with SVG elements in its own pixels over it. words: what it shows;
    they are the caption as well."""
    height_px, width_px = image.shape[:2]
    scale = min(1.0, _WIDTH_PX / width_px)
    size = max(1, round(width_px * scale)), max(1, round(height_px * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return Markup(
        '<figure><div class="picture"><img src="data:image/jpeg;base64,{content}" width="{width}" height="{height}" '
        'alt="{words}"><svg viewBox="-0.5 -0.5 {width} {height}" preserveAspectRatio="none" aria-hidden="true">{over}'
        "</svg></div><figcaption>{words}</figcaption></figure>"
    ).format(
        content=base64.b64encode(encoded).decode("ascii"),
        width=width_px,
        height=height_px,
        words=words,
        over=Markup("".join(overlay)),
    )
