"""Parse the HTML pages of reports."""

import json
from html import unescape
from html.parser import HTMLParser

VOID = {"meta", "link", "br", "hr", "img", "input"}
"""Tags without an end."""


class PageReader(HTMLParser):
    """Check that tags are closed in order; collect ids, links and what the page would load."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.links, self.loaded, self.tags, self.text = [], [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            elif name == "href" and value.startswith("#"):
                self.links.append(value[1:])
            elif name in {"href", "src", "srcset", "data", "action"}:
                self.loaded.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.text.append(data.replace("\u00a0", " "))


def read_page(text):
    """Return the tags, texts, ids and links of a page whose tags are all closed."""
    reader = PageReader()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    return reader


def read_figures(text):
    """Return the data and layout of every figure of a page, by id."""
    parts = text.split('<figure id="')[1:]
    content = [part.split('<script type="application/json">')[1].split("</script>")[0] for part in parts]
    return {part.split('"')[0]: json.loads(unescape(each)) for part, each in zip(parts, content, strict=True)}


def assert_axes_are_titled(figure):
    """Check that a figure has points, that its axes have titles, and that those of numbers have units.

    A title beside several plots stands for all of them; axes that match another one share its title.
    """
    drawn = figure if isinstance(figure, dict) else json.loads(figure.to_json())
    assert any(len(_read_values(trace, "y")) for trace in drawn["data"])
    layout = drawn["layout"]
    beside = [note for note in layout.get("annotations", ()) if "[" in note["text"] and note.get("xref") == "paper"]
    for letter in "xy":
        axes = {name: axis for name, axis in layout.items() if name.startswith(f"{letter}axis")}
        for name, axis in axes.items():
            title = axis.get("title", {}).get("text", "")
            if not title and len(axes) > 1 and (beside or axis.get("matches")):
                continue
            assert title, name
            assert axis.get("type") == "category" or "[" in title, (name, title)


def _read_values(trace, axis):
    values = trace.get(axis) or ()
    return values.get("bdata", ()) if isinstance(values, dict) else values
