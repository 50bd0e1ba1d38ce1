"""Import it before what tests share (`live`, `small_world`), which pytest finds by itself."""

import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
sys.path += [str(PROJECT / folder) for folder in ("test/helpers", "calibslam_backend/test/helpers")]
