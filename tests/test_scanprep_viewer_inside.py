"""Pages inside of another: which one is told of what, what is dropped, and that all of them are closed."""
import numpy as np
import pytest
from click_app import Clicks
from PIL import Image

from scanprep.viewer.dropped import Dropped, with_camera
from scanprep.viewer.messages import Message
from scanprep.viewer.pages import Pages


class Front(Clicks):
    """A home with one page inside."""

    title, name = "Home", "view"

    def __init__(self):
        super().__init__()
        self.page, self.back, self.broken = Clicks(), [], False

    def enter(self, send, wanted):
        self.send = send
        if wanted != {"what": "inner"}:
            raise ValueError("no such page")
        return self.page

    def on_return(self, app):
        self.back.append(app)
        if self.broken:
            raise ValueError("it cannot be read")


@pytest.fixture
def told():
    return []


def say(pages, told, kind, **fields):
    pages.handle(Message(kind, fields), told.append)


def names(told):
    out = [(message.kind, message.fields.get("name")) for message in told]
    told.clear()
    return out


def test_a_page_is_entered_and_left(told):
    home = Front()
    pages = Pages(home)
    assert [message.kind for message in pages.greet()] == ["page", "state"] and pages.name == "view"
    say(pages, told, "enter", what="inner", page=0)
    assert names(told) == [("page", "pick"), ("state", None)]
    assert (pages.name, pages.title) == ("pick", Clicks.title)
    assert pages.greet()[0].fields == {"number": 1, "name": "pick", "title": Clicks.title, "back": "Home"}
    say(pages, told, "click", n=3, page=1)
    assert home.page.seen == [3] and not home.seen
    told.clear()
    say(pages, told, "leave", page=1)
    assert home.back == [home.page] and pages.name == "view" and names(told)[0] == ("page", "view")
    say(pages, told, "enter", what="inner", page=2)                      # as it was left
    assert pages.greet()[1].fields == {"clicks": 1}


def test_a_click_on_a_page_that_was_left_lands_nowhere(told):
    home = Front()
    pages = Pages(home)
    say(pages, told, "enter", what="inner", page=0)
    say(pages, told, "click", n=1, page=0)
    say(pages, told, "enter", what="inner", page=0)                      # of a second tab
    assert not home.seen and not home.page.seen and pages.greet()[0].fields["number"] == 1
    told.clear()
    home.send(Message("late"))                                           # by a page that is not shown
    assert not told


def test_whatever_happens_one_gets_back(told):
    home = Front()
    pages = Pages(home)
    with pytest.raises(ValueError, match="no such page"):
        say(pages, told, "enter", what="other")
    assert pages.name == "view"
    say(pages, told, "enter", what="inner")
    home.broken = True
    with pytest.raises(ValueError, match="cannot be read"):
        say(pages, told, "leave")
    assert pages.name == "view"
    pages.close()
    assert (home.closed, home.page.closed) == (1, 1)


def test_of_one_name_the_last_good_file_is_kept(tmp_path):
    dropped = Dropped()
    for text in ("first", "second"):
        (tmp_path / "a.ply").write_text(text)
        with dropped.keeping("a.ply", tmp_path / "a.ply") as kept:
            assert kept.read_text() == text and dropped.holds(kept)
    (tmp_path / "a.ply").write_text("bad")
    for name in ("a.ply", "new.ply"):
        with pytest.raises(ValueError), dropped.keeping(name, tmp_path / "a.ply"):
            raise ValueError
    assert [path.name for path in dropped.folder.iterdir()] == ["a.ply"] and kept.read_text() == "second"
    dropped.close()
    assert not dropped.folder.exists()


def test_a_depth_picture_waits_for_its_camera(tmp_path):
    picture, camera = tmp_path / "one.png", tmp_path / "one.camera.json"
    camera.write_text("{}")
    assert with_camera(camera) == (picture, "one.camera.json is kept: now drop its depth picture, one.png")
    camera.unlink()
    Image.fromarray(np.zeros((4, 5), dtype=np.uint8)).save(picture)
    with pytest.raises(ValueError, match=r"one[.]png: expected distances, one channel of 16 bits, got uint8"):
        with_camera(picture)
    Image.fromarray(np.zeros((4, 5), dtype=np.uint16)).save(picture)
    assert with_camera(picture) == (picture, "one.png is kept: now drop its camera, one.camera.json")
    camera.write_text("{}")
    assert with_camera(picture) == with_camera(camera) == (picture, "")
    assert with_camera(tmp_path / "a.ply") == (tmp_path / "a.ply", "")
