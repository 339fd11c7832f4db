"""Links and anchors of the documentation resolve."""

import re

import pytest

from tests.support.pages import PAGES, anchors, links, name_of
from tests.support.paths import ROOT


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_and_anchor_resolves(page):
    for link in links(page):
        target, _, anchor = link.partition("#")
        if "://" in target:
            continue
        there = (page.parent / target).resolve() if target else page
        assert there.exists(), link
        assert there.is_relative_to(ROOT), link
        if anchor:
            assert anchor in anchors(there), link


def test_every_page_of_the_site_is_linked_from_another():
    linked = {(page.parent / link.partition("#")[0]).resolve() for page in PAGES for link in links(page)}
    site = {page for page in PAGES if ROOT / "docs" in page.parents} - {ROOT / "docs" / "index.md"}
    copies = {page for page in site if page.read_text(encoding="utf-8").startswith("<!-- included: ")}
    assert {name_of(page) for page in site - linked - copies} == set()


@pytest.mark.parametrize("lock", sorted(ROOT.glob("requirements*.lock")), ids=lambda path: path.stem)
def test_lock_file_contains_hashes_and_no_address(lock):
    pins = re.split(r"^(?=[a-z0-9])", lock.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    assert pins
    assert all("==" in pin and "--hash=sha256:" in pin and "://" not in pin for pin in pins)
