"""Rendered images: repeatable, with boxes that are those of what is seen, and classes that can be told apart."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_msgs_py.bags import BagReader
from calibslam_msgs_py.measurements import SECOND, Array, Camera
from calibslam_sim import render_dataset, simulate, topics
from calibslam_sim.rendering.coco_writer import CLASSES, DESCRIPTION, CocoError, CocoWriter
from calibslam_sim.rendering.kernels import cast, cast_shadows, visible_parts
from calibslam_sim.rendering.looks import FAMILIAR, FAMILIES, FOREIGN, looks
from calibslam_sim.rendering.render import SAME_EDGE, RenderedImage, Renderer
from calibslam_sim.simulation.camera_path import START, camera_path
from calibslam_sim.simulation.recording import CAMERA
from calibslam_sim.simulation.world import desk_world

K = np.array([[100.0, 0.0, 80.0], [0.0, 100.0, 60.0], [0.0, 0.0, 1.0]])
SMALL = Camera(width=160, height=120, K=K, distortion=np.zeros(5))
NO_ROOM = np.array([-50.0, -50.0, -50.0, 50.0, 50.0, 50.0])


def cast_two(spheres: list[tuple[list[float], float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ids, depths and pixels of whole spheres (centre, radius) seen from the origin."""
    ids, depths = np.empty((120, 160), np.int16), np.empty((120, 160), np.float32)
    centres = np.array([centre for centre, _ in spheres])
    whitening = np.array([np.eye(3) / radius for _, radius in spheres])
    rectangles = np.tile(np.array([0, 160, 0, 120]), (len(spheres), 1))
    whole = np.empty(len(spheres), np.int64)
    cast(K, np.eye(4), NO_ROOM, np.empty((0, 6)), centres, whitening, rectangles, ids, depths, whole)
    return ids, depths, whole


def test_a_sphere_is_where_geometry_says() -> None:
    # Radius 0.6 at 3 m: tangent of the half angle 0.6 / sqrt(9 - 0.36), times 100 px.
    ids, depths, whole = cast_two([([0.0, 0.0, 3.0], 0.6)])
    pixels, boxes = visible_parts(ids, 1)
    radius = 100.0 * 0.6 / np.sqrt(9.0 - 0.36)
    np.testing.assert_allclose(boxes[0], [80 - radius, 60 - radius, 80 + radius, 60 + radius], atol=0.6)
    assert pixels[0] == whole[0] == pytest.approx(np.pi * radius**2, rel=0.02)
    assert depths[60, 80] == pytest.approx(2.4, abs=1e-3)
    assert depths[0, 0] == pytest.approx(50.0)


def test_the_nearer_sphere_hides_the_other() -> None:
    ids, _, whole = cast_two([([0.0, 0.0, 3.0], 0.6), ([0.3, 0.0, 2.0], 0.2)])
    pixels, boxes = visible_parts(ids, 2)
    assert ids[60, 95] == 1 and ids[60, 70] == 0
    assert pixels[0] < whole[0] and pixels[1] == whole[1]
    # About 10 px above and below the equator the far sphere, of radius 20.4 px, is the outer one again.
    assert boxes[0, 2] == pytest.approx(80 + np.sqrt(20.4**2 - 10.0**2), abs=1.0)


def test_shadows_on_the_floor_are_those_of_all_ellipsoids() -> None:
    """Against every line to the lamp past every ellipsoid: dark below 0.7 of squared distance, light above 1.5."""
    world, room, lamp = desk_world(1), np.array([-4.0, -4.0, 0.0, 4.0, 4.0, 3.0]), np.array([0.5, 1.0, 2.9])
    centres = np.array([o.ellipsoid.T_world_object[:3, 3] for o in world])
    whitening = np.array([o.ellipsoid.T_world_object[:3, :3].T / o.ellipsoid.radii[:, None] for o in world])
    share = np.empty((60, 60), np.float32)
    cast_shadows(0.0, room, lamp, centres, whitening, share)
    steps = (np.arange(60) + 0.5) / 60 * 8.0 - 4.0
    points = np.stack([*np.meshgrid(steps, steps), np.zeros((60, 60))], axis=-1)
    expected = np.ones((60, 60))
    for centre, W in zip(centres, whitening, strict=True):
        start, end = (points - centre) @ W.T, W @ (lamp - centre)
        along = np.clip(np.sum(start * (start - end), axis=-1) / np.sum((end - start) ** 2, axis=-1), 0.0, 1.0)
        squared = np.sum((start + along[..., None] * (end - start)) ** 2, axis=-1)
        expected *= np.clip((squared - 0.7) / 0.8, 0.0, 1.0)
    np.testing.assert_allclose(share, expected, atol=1e-6)
    assert (expected == 0.0).sum() > 10 < ((expected > 0.0) & (expected < 1.0)).sum()


def test_the_same_seed_gives_the_same_image() -> None:
    world = desk_world(3)
    first, second = (Renderer(world, SMALL, 3, 1.0, "familiar").render(START) for _ in range(2))
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.visible_boxes, second.visible_boxes)
    assert first.jpeg() == second.jpeg()
    assert (Renderer(world, SMALL, 4, 1.0, "familiar").render(START).image != first.image).mean() > 0.5


def test_the_stamp_is_the_middle_of_the_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the poses of the camera that an image asks for: shutter opens, boxes, shutter closes."""
    asked = []

    def noted(times: np.ndarray, pace: float, seed: int) -> Array:
        asked.append(times)
        return camera_path(times, pace, seed)

    monkeypatch.setattr("calibslam_sim.rendering.render.camera_path", noted)
    world = desk_world(3)
    Renderer(world, SMALL, 3, 1.0, "familiar").render(START)
    ((opens, middle, closes),) = asked
    exposure = looks(world, 3, "familiar").optics.exposure_time
    assert START - opens == closes - middle == pytest.approx(exposure / 2.0 * SECOND, abs=1.0) and middle == START


def test_boxes_are_those_of_the_visible_parts() -> None:
    """Visible inside whole; equal where nothing is in front."""
    image = Renderer(desk_world(0), CAMERA, 0, 1.0, "familiar").render(START + 3 * SECOND)
    seen = image.visible_shares > 0.0
    assert seen.sum() >= 8
    visible, whole = image.visible_boxes[seen], image.whole_boxes[seen]
    assert (visible[:, :2] >= whole[:, :2] - SAME_EDGE).all() and (visible[:, 2:] <= whole[:, 2:] + SAME_EDGE).all()
    free = image.visible_shares[seen] == 1.0
    assert free.any() and not free.all()
    np.testing.assert_array_equal(visible[free], whole[free])
    assert np.isnan(image.visible_boxes[~seen]).all()


def test_an_object_is_drawn_in_its_box() -> None:
    """Without its object the image differs inside the box, and hardly outside (its shadow, the exposure)."""
    world = desk_world(0)
    k = next(thing.id for thing in world if thing.class_id == "potted plant")
    gone = np.eye(4)
    gone[:3, 3] = [0.0, 0.0, -30.0]
    without = tuple(
        replace(thing, ellipsoid=Ellipsoid(gone, thing.ellipsoid.radii)) if thing.id == k else thing for thing in world
    )
    renderers = [Renderer(w, CAMERA, 0, 1.0, "familiar") for w in (world, without)]
    for second in range(0, 50, 5):
        images = [renderer.render(START + second * SECOND) for renderer in renderers]
        if images[0].visible_shares[k] == 1.0 and images[0].in_image_shares[k] == 1.0:
            break
    difference = np.abs(images[0].image.astype(int) - images[1].image).max(axis=2) > 40
    rows, columns = np.nonzero(difference)
    xmin, ymin, xmax, ymax = images[0].visible_boxes[k]
    inside = (columns + 1 > xmin - 4) & (columns < xmax + 4) & (rows + 1 > ymin - 4) & (rows < ymax + 4)
    assert inside.mean() > 0.9
    assert difference[int(ymin) : int(ymax), int(xmin) : int(xmax)].mean() > 0.4


def test_every_class_has_its_own_look_in_both_families() -> None:
    for family in (FAMILIAR, FOREIGN):
        assert set(family) == set(CLASSES)
        assert len({(look.pattern, look.colours) for look in family.values()}) == len(CLASSES)
    assert all(FAMILIAR[name].pattern != FOREIGN[name].pattern for name in CLASSES)
    first, second = (Renderer(desk_world(0), SMALL, 0, 1.0, family).render(START) for family in FAMILIES)
    np.testing.assert_array_equal(first.whole_boxes, second.whole_boxes)
    assert (first.image != second.image).mean() > 0.5


def test_a_bag_holds_the_images_and_a_folder_their_boxes(tmp_path: Path) -> None:
    bag, coco = tmp_path / "bag", tmp_path / "coco"
    arguments = ["--out", str(bag), "--images", "--coco", str(coco), "--duration", "0.1", "--seed", "2"]
    assert simulate.main(arguments) == 0
    with BagReader(bag) as reader:
        images = [message for _, _, message in reader.messages([topics.IMAGE])]
        boxes = [message for _, _, message in reader.messages([topics.DETECTIONS])]
    assert [m.header.stamp for m in images] == [m.header.stamp for m in boxes]
    assert images[0].header.frame_id == CAMERA.frame_id and images[0].format == "jpeg"
    files = sorted((coco / "images").iterdir())
    assert [file.read_bytes() for file in files] == [bytes(message.data) for message in images]
    assert cv2.imread(str(files[0])).shape == (480, 640, 3)
    data = COCO(str(coco / "annotations.json"))
    assert [c["name"] for c in data.loadCats(data.getCatIds())] == list(CLASSES)
    clear = data.loadAnns(data.getAnnIds(imgIds=[1], iscrowd=False))
    assert clear and all(a["visible_share"] >= 0.3 and min(a["bbox"][2:]) >= 8.0 for a in clear)
    # The bag is there already; neither it nor the data set is touched.
    assert simulate.main(arguments) == 1
    # Nor where only the bag is refused.
    (bag / "mine.txt").touch()
    assert simulate.main([*arguments, "--overwrite"]) == 1
    assert sorted((coco / "images").iterdir()) == files and (coco / "annotations.json").exists()
    other = tmp_path / "other"
    assert simulate.main([*arguments, "--coco", str(other)]) == 1
    assert not other.exists()
    with pytest.raises(SystemExit):
        simulate.main([*arguments, "--out", str(other), "--coco", str(other / "coco")])


def test_a_data_set_of_several_worlds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--out", str(tmp_path / "d"), "--worlds", "2", "--images-per-world", "1", "--looks", "foreign"]
    assert render_dataset.main(arguments) == 0
    content = json.loads((tmp_path / "d" / "annotations.json").read_text())
    assert [image["file_name"] for image in content["images"]] == ["000001.jpg", "000002.jpg"]
    assert render_dataset.main(arguments) == 1
    assert "not overwritten" in capsys.readouterr().err
    assert render_dataset.main([*arguments, "--overwrite"]) == 0
    (tmp_path / "d" / "mine.txt").touch()
    assert render_dataset.main([*arguments, "--overwrite"]) == 1


def listed(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize(
    "files",
    [
        {"images/holiday/me.png": ""},
        {"images/me.png": ""},
        {"images": ""},
        {"annotations.json": '{"info": {"description": "mine"}, "images": []}', "images/a.jpg": ""},
        {"annotations.json": '{"images": [{"file_name": "a.jpg"}]}', "images/a.jpg": ""},
        {"annotations.json": "[", "images/a.jpg": ""},
        {"annotations.json": f'{{"info": {{"description": "{DESCRIPTION}"}}, "images": [{{"file_name": "b"}}]}}',
         "images/b": "", "images/c": ""},
    ],
)  # fmt: skip
def test_only_data_sets_of_ours_are_replaced(files: dict[str, str], tmp_path: Path) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    before = listed(tmp_path)
    with pytest.raises(CocoError, match=f"{tmp_path} is not overwritten"):
        CocoWriter(tmp_path, overwrite=True)
    assert listed(tmp_path) == before


def test_a_data_set_is_replaced_when_there_is_another(tmp_path: Path) -> None:
    options = ["--out", str(tmp_path / "d"), "--worlds", "1"]
    assert render_dataset.main([*options, "--images-per-world", "2"]) == 0
    before = listed(tmp_path)
    assert CocoWriter(tmp_path / "d", overwrite=True).close() == 0
    assert listed(tmp_path) == before
    assert render_dataset.main([*options, "--images-per-world", "1", "--overwrite"]) == 0
    assert listed(tmp_path / "d") == ["annotations.json", "images", "images/000001.jpg"]


@pytest.mark.parametrize(("ending", "code"), [(KeyboardInterrupt, 130), (OSError, 1)])
def test_images_have_annotations_also_when_it_was_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: type[BaseException], code: int
) -> None:
    render, done = Renderer.render, []

    def interrupted(self: Renderer, time: int) -> RenderedImage:
        if len(done) == 2:
            raise ending
        done.append(time)
        return render(self, time)

    monkeypatch.setattr(Renderer, "render", interrupted)
    options = ["--out", str(tmp_path / "d"), "--worlds", "1", "--images-per-world", "3"]
    assert render_dataset.main(options) == code
    content = json.loads((tmp_path / "d" / "annotations.json").read_text())
    assert [image["file_name"] for image in content["images"]] == ["000001.jpg", "000002.jpg"]
    assert {annotation["image_id"] for annotation in content["annotations"]} == {1, 2}


def test_coco_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        simulate.main(["--out", str(tmp_path / "bag"), "--coco", str(tmp_path / "coco")])
