"""The services of the back end: reset, pause, save_map and load_map. Each answer says what happened, or why not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calibslam_msgs.srv import LoadMap, SaveMap
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from calibslam_backend.association.relocalisation import FOUND
from calibslam_backend.output.map_folder import PathRefused, confined
from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.session.session import NotReady, Session


class MapServices:
    """Offers them on a node; maps lie in a folder. `start_in_map` is the setting of this name."""

    def __init__(self, node: Node, session: Session, folder: Path, start_in_map: str) -> None:
        self._session, self._folder, self._start_in_map = session, folder, start_in_map
        node.create_service(Trigger, "~/reset", self._reset)
        node.create_service(SetBool, "~/pause", self._pause)
        node.create_service(SaveMap, "~/save_map", self._save)
        node.create_service(LoadMap, "~/load_map", self._load)

    def save(self, path: str, **options: float) -> str:
        """Write the map; returns what was written.

        Raises:
            NotReady: it could not be; the text says why.
        """
        try:
            return self._session.save(confined(path, self._folder), **options)
        except PathRefused as error:
            raise NotReady(str(error)) from None
        except OSError as error:
            raise NotReady(f"cannot write {path}: {error.strerror or error}") from None
        except RuntimeError as error:
            raise NotReady(f"the estimate cannot be used: {error}") from None

    def _reset(self, _: Any, response: Any) -> Any:
        try:
            self._session.reset()
            response.success, response.message = True, "map and trajectory are empty"
        except NotReady as error:
            response.success, response.message = False, str(error)
        return response

    def _pause(self, request: Any, response: Any) -> Any:
        self._session.intake.paused = bool(request.data)
        response.success = True
        response.message = "paused: measurements are ignored" if request.data else "running"
        return response

    def _save(self, request: Any, response: Any) -> Any:
        try:
            response.success, response.message = True, self.save(request.path)
        except NotReady as error:
            response.success, response.message = False, str(error)
        return response

    def _load(self, request: Any, response: Any) -> Any:
        try:
            self._session.check_ready()
            known = ObjectMap.load(confined(request.path, self._folder))
            self._session.load(known)
        except (NotReady, ValueError) as error:
            response.success, response.message = False, str(error)
            return response
        except Exception as error:  # whatever a file may do to those who read it, the node goes on
            response.success = False
            response.message = f"{request.path} cannot be loaded: {type(error).__name__}: {error}"
            return response
        start = (
            "the camera is looked for by the objects it sees"
            if self._start_in_map == FOUND
            else "the robot must be where that map was begun"
        )
        response.success, response.message = True, f"{len(known.quadrics)} objects; {start}"
        if self._session.intake.journal_problem:
            response.message += f"; the journal {self._session.intake.journal_problem}"
        return response
