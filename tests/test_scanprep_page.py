"""The page of a set: worst first, every scan on it, nothing that must be fetched; and the figures behind it."""
import re
from dataclasses import replace

import numpy as np
import pytest
from scan_folders import MARKS, QUICK, ball, write_scans
from scene_reader import scenes_of
from scipy.spatial.transform import Rotation

from scanprep import RegisteredSet, Skeleton, write_landmarks, write_mesh
from scanprep.geometry.files import PointCloud, write_points
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.tables import read_table
from scanprep.judgement import Judgement
from scanprep.pipeline import page as pictures
from scanprep.pipeline.page import judge_whole, write_set_page
from scanprep.pipeline.prepare import prepare
from scanprep.pipeline.scans import find_scans
from scanprep.registration.figures import (
    Limits,
    ScanFigures,
    Verdict,
    read_doubts,
    read_failures,
    read_figures,
    review,
    write_doubts,
    write_failures,
    write_figures,
)
from scanprep.registration.limbs import PlausibilityIssue
from scanprep.registration.nonrigid import principal_stretches, share_stretched, share_uncovered

GOOD = ScanFigures("good", "10 landmarks", 0.001, 0.0015, 0.85, 0.85, 0.0, 0.004, 0.002, 0, True, 0.0, 3.25)


@pytest.fixture(scope="module")
def template():
    return ball()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, template):
    """A set of two scans that fit, one cut in half, a cloud with clutter, and one that cannot be read."""
    place = tmp_path_factory.mktemp("page")
    scans = write_scans(place / "scans", template, 5)
    half = template.submesh(template.face_normals[:, 1] > 0.3)[0]
    write_mesh(scans / "body2.ply", half)
    cloud = np.vstack([template.vertices, template.vertices * 0.2 + [2.0, 0, 0]])
    (scans / "body3.ply").unlink()
    for name in ("body2", "body3"):
        write_landmarks(scans / f"{name}.landmarks.json", {mark: template.vertices[v] for mark, v in MARKS.items()})
    write_points(scans / "body3.xyz", PointCloud(cloud, None, None))
    (scans / "body4.ply").write_text("no mesh <b>")
    prepare(find_scans(scans), template, MARKS, place / "set", QUICK)
    return place / "set"


def test_worst_first(folder):
    page = (folder / "report.html").read_text()
    assert re.findall(r'<section class="scan (\w+)"><h3><span class="dot"></span>(\w+) ', page)[:2] == [
        ("failed", "body4"), ("look", "body3")]
    order = [float(number) for number in re.findall(r"<small>([\d.]+)</small>", page)]
    assert len(order) == 4 and order == sorted(order, reverse=True)
    assert "body4.ply" in page and "of the scan lies off the template" in page


def test_everything_is_in_the_page(folder):
    page = (folder / "report.html").read_text()
    sources = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert all(s.startswith(("data:image/", "#")) for s in sources)
    assert sum(s.startswith("data:image/webp") for s in sources) == 4
    turning = scenes_of(page)
    assert turning and page.count('loading="lazy"') == 4 - len(turning)
    first = turning[0].header["panes"]
    assert [pane["label"] for pane in first] == ["scan", "the template on it"]
    assert first[0]["camera"] == first[1]["camera"]
    registered = turning[0].layer("registered template")
    assert [shade["name"] for shade in registered["shades"]] == ["distance to the scan", "not sure", "plain"]


def test_pictures_show_what_they_say(folder):
    """The half that was not scanned is grey on one side; the scan of points looks like a body."""
    from PIL import Image

    shown = np.asarray(Image.open(folder / "pictures" / "body0.webp").convert("RGB")).astype(int)
    assert shown.shape == (pictures.HEIGHT, pictures.WIDTH * len(pictures.PANELS), 3)
    covered = [(panel.min(axis=2) < 240).mean() for panel in np.split(shown, len(pictures.PANELS), axis=1)]
    assert min(covered) > 0.1 and np.ptp(covered) < 0.03        # the same body in the same place in all of them
    half = np.asarray(Image.open(folder / "pictures" / "body2.webp").convert("RGB")).astype(int)
    front, back = np.split(half, len(pictures.PANELS), axis=1)[2:4]

    def colored(panel):
        return (np.ptp(panel, axis=2) > 60).mean()

    assert max(colored(front), colored(back)) > 4 * min(colored(front), colored(back))


def test_names_cannot_break_the_page(folder, tmp_path):
    whole = RegisteredSet.create(tmp_path / "set", ball(0))
    whole.add("a b&c", ball(0).vertices, "<script>", "'\"")
    write_figures(tmp_path / "set", [Verdict("a b&c", 0.0, (), replace(GOOD, name="a b&c"))])
    write_failures(tmp_path / "set", {"d": "<i>broken</i>"})
    page = write_set_page(tmp_path / "set").read_text()
    assert "<script" not in page and "<i>" not in page and "a b&amp;c" in page


@pytest.mark.parametrize("change, reason", [
    ({"missed": 0.02}, "off the template"), ({"distance": 0.004}, "on average"), ({"seen": 0.5}, "without data"),
    ({"stretch": 0.05}, "stretched"), ({"inverted": 30}, "inverted"), ({"landmarks": 0.04}, "landmarks"),
    ({"converged": False}, "converged"), ({"seen": 0.0, "distance": np.nan, "rms": np.nan}, "nowhere near")])
def test_each_figure_alone_is_noticed(change, reason):
    figures = [replace(GOOD, name=f"good{k}") for k in range(4)] + [replace(GOOD, name="bad", **change)]
    verdicts = review(figures, {}, size=1.4, faces=25_000, limits=Limits(not_converged=1))
    assert verdicts[0].name == "bad" and verdicts[0].suspect and any(reason in r for r in verdicts[0].reasons)
    assert not any(v.suspect or v.reasons for v in verdicts[1:])


def test_order_of_verdicts():
    figures = [replace(GOOD, name="a"), replace(GOOD, name="b", missed=0.02), replace(GOOD, name="c", missed=0.2),
               replace(GOOD, name="d", landmarks=np.nan)]
    verdicts = review(figures, {"a": "gone", "z": "broken"}, 1.4, 25_000, Limits(missed=0.01))
    assert [v.name for v in verdicts] == ["a", "z", "c", "b", "d"]
    assert [v.failed for v in verdicts] == [True, True, False, False, False]
    assert [v.badness for v in verdicts[2:4]] == [pytest.approx(20), pytest.approx(2)]


def test_a_rolled_limb_puts_a_scan_on_top(tmp_path):
    figures = [replace(GOOD, name=name) for name in "abc"]
    rolled = PlausibilityIssue(3.0, "the left forearm is rolled by 160 degrees against the left upper arm")
    write_doubts(tmp_path,
                 {"b": [rolled, PlausibilityIssue(1.2, "the head is 20% smaller than on the template")], "a": []})
    verdicts = review(figures, {}, 1.4, 25_000, doubts=read_doubts(tmp_path))
    assert verdicts[0].name == "b" and verdicts[0].badness == 3.0 and verdicts[0].reasons[0] == rolled.words
    assert [v.judgement.verdict for v in verdicts] == ["check", "good", "good"]
    assert review(figures, {"a": "gone"}, 1.4, 25_000)[0].judgement == Judgement("failed", ("gone",))
    assert not any(v.suspect for v in review(figures, {}, 1.4, 25_000, Limits(limbs=4), read_doubts(tmp_path)))


def test_scans_from_one_side_are_not_blamed_for_it():
    front = [replace(GOOD, name=f"front{k}", seen=0.4) for k in range(5)]
    verdicts = review(front, {}, 1.4, 25_000)
    assert not any(v.suspect for v in verdicts)
    said = "60% of a body has no data in these scans: what is there is a guess"
    assert judge_whole(verdicts, None).reasons == (said,)
    assert judge_whole(review([replace(f, seen=0.8) for f in front], {}, 1.4, 25_000), None).verdict == "good"


@pytest.mark.parametrize(("sizes", "said"), [(np.linspace(0.99, 1.01, 8), None),
                                             (np.linspace(0.93, 1.07, 8), "different people")])
def test_a_set_is_doubted_for_its_skeleton_and_first_for_several_people_in_it(template, tmp_path, sizes, said):
    verdicts, tree = review([GOOD], {}, 1.4, 25_000), Skeleton([0, 1], [-1, 0], np.zeros((2, 3)))
    whole = replace(RegisteredSet.create(tmp_path / "set", template), skeleton=tree)
    for number, size in enumerate(sizes):
        whole = whole.add(f"pose{number}", size * template.vertices, subject="anna")
    assert (judge_whole(verdicts, whole, parts=2).verdict == "good") == (said is None)
    reasons = judge_whole(verdicts, whole, parts=16).reasons
    assert "no skeleton of 16 parts was found, the nearest has 2" in reasons[-1]
    assert said is None or said in reasons[0]


def test_stretches_of_a_known_map(template):
    R = Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix()
    flat = template.with_vertices(template.vertices * [1, 1, 0] + [0, 0, 1])
    grown = flat.with_vertices((flat.vertices * [3.0, 0.5, 1]) @ R.T + 7)
    usable = flat.face_areas > 1e-6
    long, short = principal_stretches(flat, grown)
    np.testing.assert_allclose(long[usable], 3, rtol=1e-6)
    np.testing.assert_allclose(short[usable], 0.5, rtol=1e-6)
    moved = template.with_vertices(template.vertices @ R.T)
    np.testing.assert_allclose(np.concatenate(principal_stretches(template, moved)), 1, atol=1e-9)
    assert share_stretched(template, moved) == 0
    assert share_stretched(template, template.with_vertices(0.4 * template.vertices)) == 0         # somebody small
    half = np.where(template.vertices[:, :1] > np.median(template.vertices[:, 0]) + 0.2, [2.5, 1, 1], 1)
    assert 0.05 < share_stretched(template, template.with_vertices(half * template.vertices)) < 0.5


def test_missed_points(template):
    # one and the same body twice, the second one 3 m away: half of the surface, though it has six vertices in seven
    second = template.corners.reshape(-1, 3) + [3, 0, 0]
    faces = np.concatenate([template.faces, len(template.vertices) + np.arange(len(second)).reshape(-1, 3)])
    both = Mesh(np.concatenate([template.vertices, second]), faces)
    assert share_uncovered(both, template, 0.01) == pytest.approx(0.5, abs=1e-6)


def test_tables_keep_their_numbers(tmp_path):
    rows = [replace(GOOD, name="b", landmarks=np.nan),
            replace(GOOD, name="a", distance=1 / 3, converged=False, rolled=True)]
    failed = Verdict("c", np.inf, ("c.ply: no person",))
    write_figures(tmp_path, [Verdict("b", 2.0, ("far off", "an arm"), rows[0]), failed, Verdict("a", 0.5, (), rows[1])])
    told = [(row["name"], row["verdict"], row["reasons"]) for _, row in read_table(tmp_path / "registration.csv", ())]
    assert told == [("a", "good", ""), ("b", "check", "far off; an arm"), ("c", "failed", "c.ply: no person")]
    assert [repr(f) for f in read_figures(tmp_path)] == [repr(rows[1]), repr(rows[0])]
    table = tmp_path / "registration.csv"
    lines = [line.rsplit(",", 3)[0] for line in table.read_text().splitlines() if not line.startswith("c,")]
    table.write_text("\n".join(lines))
    assert [f.rolled for f in read_figures(tmp_path)] == [False, False]           # a table of before
    write_failures(tmp_path, {"x": 'a, "b"\tc'})
    assert read_failures(tmp_path) == {"x": 'a, "b"\tc'}
    (tmp_path / "registration.csv").write_text("name,distance\na,1\n")
    with pytest.raises(ValueError, match=r"registration\.csv: expected the columns name, init"):
        read_figures(tmp_path)
