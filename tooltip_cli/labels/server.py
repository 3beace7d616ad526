"""The labelling server: one page, its images, and changes to one label file; loopback only."""

from __future__ import annotations

import json
import logging
import math
import secrets
import socket
from collections.abc import Awaitable, Callable
from functools import partial
from importlib import resources
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.book import ConflictError, Entry, TipLabel
from tooltip_cli.labels.files import STATES
from tooltip_cli.labels.guard import Guard
from tooltip_cli.labels.session import Session
from tooltip_cli.log.images import viewable

ADDRESS = "127.0.0.1"
_ASSETS = {
    "": ("index.html", "text/html; charset=utf-8"),
    "label.css": ("label.css", "text/css; charset=utf-8"),
    "icon.svg": ("icon.svg", "image/svg+xml"),
    **{
        name: (name, "text/javascript; charset=utf-8")
        for name in (
            "main.js",
            "images.js",
            "keys.js",
            "labels.js",
            "saving.js",
            "strip.js",
            "view.js",
        )
    },
}
_Handler = Callable[[Session, Request, bytes], Response]
_LOGGER = logging.getLogger(__name__)


class BadRequestError(TooltipError):
    """A request that this page would not send."""


def application(session: Session, token: str, port: int) -> Starlette:
    """Return the ASGI application under ``/TOKEN/``.

    What a client sends is compared with what there is (names of assets, indices of images, stamps
    of frames); no part of it becomes a path or a file name.
    """
    routes = [
        Route(f"/{token}/{name}", _asset(file, media_type), methods=["GET"])
        for name, (file, media_type) in _ASSETS.items()
    ]
    handlers: dict[str, _Handler] = {
        "state": _state,
        "hints": _hints,
        "image/{index}": partial(_image, session.images),
    }
    routes += [
        Route(f"/{token}/{path}", _answering(session, handler), methods=["GET"])
        for path, handler in handlers.items()
    ]
    routes.append(Route(f"/{token}/label", _answering(session, _label), methods=["POST"]))
    return Starlette(routes=routes, middleware=[Middleware(Guard, token=token, port=port)])


def _asset(file: str, media_type: str) -> Callable[[Request], Awaitable[Response]]:
    data = (resources.files("tooltip_cli.labels") / "page" / file).read_bytes()

    async def answer(request: Request) -> Response:
        return Response(data, media_type=media_type)

    return answer


def _answering(session: Session, handler: _Handler) -> Callable[[Request], Awaitable[Response]]:
    """Return the endpoint of a handler, run on a thread; what it refuses becomes an answer."""

    async def answer(request: Request) -> Response:
        body = await request.body()
        try:
            return await run_in_threadpool(partial(handler, session, request, body))
        except BadRequestError as error:
            return JSONResponse({"error": str(error)}, 422)
        except ConflictError as error:
            return JSONResponse({"error": str(error), **_entry(error.entry)}, 409)
        except TooltipError as error:
            _LOGGER.warning("%s", error)
            return JSONResponse({"error": str(error)}, 500)

    return answer


def _entry(entry: Entry) -> dict[str, Any]:
    label = entry.label
    if label is None:
        return {"revision": entry.revision, "label": None}
    u, v = label.pixel or (None, None)
    shown = {"state": label.state, "u": u, "v": v, "labeler": label.labeler}
    return {"revision": entry.revision, "label": shown}


def _state(session: Session, request: Request, body: bytes) -> Response:
    recording, stamps = session.recording, session.stamps_ns
    count = len(recording.image_stamps_ns)
    entries = session.book.entries(stamps)
    frames = [
        # stamps go as text: they are beyond what JavaScript's numbers hold exactly
        {"stamp_ns": str(stamp), "image": int(image), **_entry(entry)}
        for stamp, image, entry in zip(stamps, session.frames, entries, strict=True)
    ]
    return JSONResponse(
        {
            "recording": recording.sha256,
            "name": recording.path.stem,
            "file": session.book.path.name,
            "labeler": session.labeler,
            "width": session.size[0],
            "height": session.size[1],
            "images": count,
            "hints": session.hints is not None,
            "frames": frames,
        }
    )


def _hints(session: Session, request: Request, body: bytes) -> Response:
    if session.hints is None:
        return JSONResponse({"error": "a blind labeller sees no hints"}, 403)
    hints = session.hints()
    return JSONResponse(
        {
            "detections": {str(image): pixel for image, pixel in hints.detections.items()},
            "predictions": {str(image): pixel for image, pixel in hints.predictions.items()},
            "notes": hints.notes,
        }
    )


def _image(images: frozenset[int], session: Session, request: Request, body: bytes) -> Response:
    text = request.path_params["index"]
    index = int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else -1
    if index not in images:
        return JSONResponse({"error": "no such image"}, 404)
    recording = session.recording
    try:
        (message,) = recording.image_messages([index])
    except OSError as error:
        raise TooltipError(f"{recording.path}: cannot be read any more ({error})") from error
    data, media_type = viewable(message, recording.image_type, f"{recording.path}: image {index}")
    return Response(data, media_type=media_type)


def _label(session: Session, request: Request, body: bytes) -> Response:
    stamp_ns, revision, label = _parse_change(session, body)
    return JSONResponse(_entry(session.book.change(stamp_ns, revision, label)))


def _parse_change(session: Session, body: bytes) -> tuple[int, int, TipLabel | None]:
    """Return stamp, revision and label of a change.

    Raises:
        BadRequestError: it is not one, or not one of these frames.
    """
    try:
        document = json.loads(body)
        recording, stamp_text = document["recording"], document["stamp_ns"]
        revision, label = document["revision"], document["label"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadRequestError(f"not a change of a label ({error!r})") from error
    if recording != session.recording.sha256:
        raise BadRequestError(
            "this label is of another recording; close this page and open the one that "
            "'tooltip label' printed"
        )
    stamps = {str(stamp): stamp for stamp in session.stamps_ns}
    if not isinstance(stamp_text, str) or stamp_text not in stamps:
        raise BadRequestError(f"no frame to label has the stamp {stamp_text!r:.40}")
    if not isinstance(revision, int):
        raise BadRequestError("the revision is no whole number")
    return stamps[stamp_text], revision, _parse_label(session, label)


def _parse_label(session: Session, label: Any) -> TipLabel | None:
    if label is None:
        return None
    if not isinstance(label, dict) or label.get("state") not in STATES:
        raise BadRequestError(f"expected a label whose state is one of {', '.join(STATES)}")
    if label["state"] != "visible":
        return TipLabel(label["state"], None, session.labeler)
    u, v = _number(label.get("u")), _number(label.get("v"))
    width, height = session.size
    # comparisons with 'not a number' fail
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise BadRequestError(f"the point lies outside the {width}x{height} image")
    return TipLabel("visible", (round(u, 2), round(v, 2)), session.labeler)


def _number(value: Any) -> float:
    if type(value) not in (int, float):
        raise BadRequestError("expected a point: the numbers u and v")
    return float(value) if abs(value) < 1e9 else math.inf


def listen(port: int) -> socket.socket:
    """Return a socket that listens on this machine alone; port 0 takes a free one.

    Raises:
        TooltipError: the port is taken.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((ADDRESS, port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise TooltipError(
            f"port {port} cannot be opened ({error.strerror}); choose another with --port"
        ) from error
    return listening


class LabelServer:
    """A server that listens already, and answers once :meth:`run` is called."""

    def __init__(self, session: Session, port: int = 0) -> None:
        """Listen; raises TooltipError where the port is taken, port 0 takes a free one."""
        self._socket = listen(port)
        port = int(self._socket.getsockname()[1])
        token = secrets.token_urlsafe(24)
        self.url = f"http://{ADDRESS}:{port}/{token}/"
        config = uvicorn.Config(
            application(session, token, port),
            http="h11",
            ws="none",
            loop="asyncio",
            lifespan="off",
            log_config=None,
            access_log=False,
            proxy_headers=False,
            server_header=False,
            limit_concurrency=64,
            h11_max_incomplete_event_size=16384,
            timeout_graceful_shutdown=2,
        )
        self._server = uvicorn.Server(config)

    def run(self) -> None:
        """Serve until :meth:`stop` is called or, in the main thread, until Ctrl-C."""
        try:
            self._server.run(sockets=[self._socket])
        except KeyboardInterrupt:  # raised again by uvicorn after everything was answered
            _LOGGER.info("interrupted")
        finally:
            self._socket.close()

    def stop(self) -> None:
        """Let :meth:`run` answer what it is at, and return."""
        self._server.should_exit = True
