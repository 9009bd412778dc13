"""Commands that work through many things: the order and the page of what came of them, and what is told of all."""

import numpy as np

from scanprep.batch.workspace import Results
from scanprep.console import Metric, judgement_row
from scanprep.folders import PICTURE, FolderCommand, figure, judgement_on
from scanprep.judgement import Judgement
from scanprep.pictures.scene import SCENE
from scanprep.pictures.sheets import save_png

SHEEP = FolderCommand(("sheep", "sheep"), "{} counted", lambda results, count: [Metric("sheep", count)],
                      lambda rows: figure(rows, "error"), {"count": 1}, hint="Count `again`.")


def rows(verdict, error):
    return [judgement_row(Judgement(verdict, ("why",) if verdict != "good" else ())), Metric("error", error, "mm")]


RESULTS = Results({"a": rows("good", 2.0), "b": rows("failed", 1.0), "c": rows("check", 7.0), "d e": rows("good", 8.0)},
                  {"f": "f.ply: no sheep"}, ("a",))


def test_worst_first():
    """What has no result, then by verdict, then by error, then by name; at the end what was not done yet."""
    assert SHEEP.worst_first(RESULTS, ["new", "a", "b", "c", "d e", "f"]) == ["f", "b", "c", "d e", "a", "new"]
    unknown = Results({"a": rows("good", 2.0), "b": rows("good", np.nan), "c": rows("good", 3.0)}, {}, ())
    assert SHEEP.worst_first(unknown, "abc") == ["b", "c", "a"]
    assert judgement_on("new", RESULTS) is None and judgement_on("f", RESULTS).reasons == ("f.ply: no sheep",)


def test_each_has_the_way_to_its_page_and_what_can_be_shown(tmp_path):
    for name in ("a", "c"):
        save_png(tmp_path / name / PICTURE, np.zeros((4, 4, 3), dtype=np.uint8))
    (tmp_path / "c" / SCENE).write_bytes(b"a scene")
    html = SHEEP.page(RESULTS, ["f.ply: no sheep"], tmp_path).html()
    assert sorted(RESULTS.values, key=lambda name: html.index(f">{name}</b>")) == ["b", "c", "d e", "a"]
    assert "<h1>4 sheep counted</h1>" in html and "<code>again</code>" in html
    assert html.index("f.ply: no sheep") < html.index('href="b/report.html"') and 'href="d%20e/report.html"' in html
    assert html.count("data-scene=") == 1 and 'src="a/picture.png"' in html and "error: 2 mm" in html
