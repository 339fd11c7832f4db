"""Parse the HTML pages of reports."""

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
            self.text.append(data)


def read_page(text):
    """Return the tags, texts, ids and links of a page whose tags are all closed."""
    reader = PageReader()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    return reader
