"""Where services may read and write."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibslam_backend.output.map_folder import PathRefused, confined


@pytest.mark.parametrize("path", ["map.json", "a/b/map.json", "a/../map.json", "./map.json", "ABSOLUTE/map.json"])
def test_files_in_the_folder(path: str, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    file = confined(path.replace("ABSOLUTE", str(tmp_path)), tmp_path)
    assert file.is_relative_to(tmp_path) and file.name == "map.json"


@pytest.mark.parametrize(
    "path", ["../map.json", "/etc/passwd", "a/../../map.json", "out/map.json", "", ".", "a\0b", "~/../../x"]
)
def test_paths_that_lead_out_of_it_or_nowhere(path: str, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    (folder / "out").symlink_to(tmp_path)
    with pytest.raises(PathRefused, match=r"is not a file in|is no path|path is empty"):
        confined(path, folder)


def test_the_folder_itself_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert confined("map.json", tmp_path / "link") == tmp_path / "real" / "map.json"
