import re
from html.parser import HTMLParser

import numpy as np
import pytest

from scanprep.pictures.page import Page


class Reader(HTMLParser):
    """Tags with their attributes, and words."""

    def __init__(self, text):
        super().__init__()
        self.found, self.words = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data.strip())

    def all(self, tag):
        return [attrs for name, attrs in self.found if name == tag]


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 255, (12, 20, 3), dtype=np.uint8)


def test_everything_is_in_the_one_file(image, tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([1, 2, 3])
    page = (Page("A <title>", "Lead & all").section("One", "First.\n\nSecond.").picture(image, "A picture")
            .section("Two").picture(image, "left").picture(image, "right").chart(figure, "A chart")
            .section("Three").table([("error", 9.51234, True), ("bodies", 1820, "–")], ("metric", "value", "ok")))
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert text == page.html()
    read = Reader(text)
    assert read.words.count("A <title>") == 2 and "Lead & all" in read.words
    assert [i["alt"] for i in read.all("img")] == ["A picture", "left", "right", "A chart"]
    for attrs in read.all("img"):
        assert attrs["src"].startswith("data:image/")
    assert not read.all("script") and not read.all("link")
    outside = re.findall(r'(?:src|href)="(?!data:|#)|url\(|@import', text)
    assert not outside
    assert {"9.51", "1,820", "yes", "First.", "Second."} <= set(read.words)
    assert [a["href"] for a in read.all("nav") and read.all("a")[:3]] == ["#s1", "#s2", "#s3"]


def test_a_page_says_that_nothing_leaves_the_computer_and_where_the_files_are():
    words = " ".join(Reader(Page("walk").html()).words)
    assert "no data leave your computer" in words and "in the folder of this page" in words


def test_text_is_escaped():
    nasty = '<script>alert("x")</script>'
    page = Page(nasty, nasty).section(nasty, nasty).table([(nasty,)], (nasty,))
    assert not Reader(page.html()).all("script")


def test_names_in_a_chart_are_no_formulas():
    from matplotlib.figure import Figure

    figure = Figure()
    axes = figure.subplots()
    axes.plot([0, 1], label="$\\frac{$")
    axes.set_yticks([0, 1], ["a$b$", "$\\nothing$\nmore"])
    axes.legend()
    assert "<svg" in Page("a").chart(figure).html() or "data:image/svg" in Page("a").chart(figure).html()
