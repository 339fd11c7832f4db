"""The web application: static files, JSON routes and the socket of the fleet."""

import asyncio
import logging
import mimetypes
from pathlib import Path
from typing import Any, Final

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from socast.core.errors import SocastError
from socast.core.files import UNREADABLE
from socast.tools.workbench.access import READY, refuse
from socast.tools.workbench.connections import REQUEST_S
from socast.tools.workbench.fleet.feed import FleetFeed
from socast.tools.workbench.fleet.frames import describe_frames
from socast.tools.workbench.fleet.routes import ROUTES as FLEET_ROUTES
from socast.tools.workbench.fleet.tiles import TileFile
from socast.tools.workbench.json_routes import JsonRequest, JsonRoute, NotFoundError, Workbench
from socast.tools.workbench.loop.routes import ROUTES as LOOP_ROUTES

STATIC: Final = Path(__file__).parent / "static"
"""Folder of the pages, styles and scripts."""
LARGEST_BODY: Final = 64 << 10
"""Largest body of a request. [B]"""
READ_ONLY: Final = "this workbench is read-only: start `socast serve` without --read-only to change something"
_TYPES: Final = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}
_encode = msgspec.json.Encoder(enc_hook=lambda value: value.item() if hasattr(value, "item") else str(value)).encode
_log = logging.getLogger("socast.workbench")


def _get_session(workbench: Workbench, _: JsonRequest) -> dict[str, Any]:
    """Return what the workbench was started with."""
    from importlib.metadata import version  # noqa: PLC0415 - takes 40 ms to import

    return {
        **workbench.workspace.describe(),
        "version": version("socast"),
        "read_only": workbench.read_only,
        "time_zone": workbench.time_zone,
        "fleet": workbench.fleet and workbench.fleet.describe(),
        "columns": describe_frames()["columns"],
        "tiles": workbench.tiles and workbench.tiles.range._asdict(),
    }


SHELL_ROUTES: Final = (
    JsonRoute("/session", _get_session),
    JsonRoute("/jobs/{job}", lambda workbench, request: workbench.jobs.describe(request.path["job"])),
    JsonRoute(
        "/jobs/{job}/cancel", lambda workbench, request: workbench.jobs.cancel(request.path["job"]), changes=True
    ),
)
"""Routes that every page uses."""


def make_application(workbench: Workbench) -> Starlette:
    """Return the web application of a workbench, without the control of access."""
    files = {f"/static/{path.name}": path for path in sorted(STATIC.iterdir()) if path.suffix in _TYPES}
    files["/"] = STATIC / "index.html"
    feed = FleetFeed(workbench.fleet) if workbench.fleet is not None else None
    routes: list[BaseRoute] = [Route(path, _make_file_endpoint(file)) for path, file in files.items()]
    routes += [_make_route(workbench, route) for route in (*SHELL_ROUTES, *FLEET_ROUTES, *LOOP_ROUTES)]
    if feed is not None:
        routes.append(WebSocketRoute("/fleet.socket", feed.serve))

    def answer_whether_ready(_: Request) -> Response:
        problem = feed.find_problem() if feed is not None else ""
        return PlainTextResponse(f"{problem or 'ok'}\n", 503 if problem else 200)

    routes.append(Route(READY, answer_whether_ready))
    if workbench.tiles is not None:
        routes.append(Route("/tiles/{zoom:int}/{x:int}/{y:int}", _make_tile_endpoint(workbench.tiles)))

    async def miss(request: Request, _: Exception) -> Response:
        return refuse(request.url.path, f"{request.url.path[:80]} does not exist here", 404)

    return Starlette(routes=routes, exception_handlers={404: miss, 405: miss})


def _make_file_endpoint(file: Path) -> Any:
    """Return the endpoint that answers with a file of the workbench."""
    kind = _TYPES.get(file.suffix) or mimetypes.guess_type(file.name)[0]

    def answer(_: Request) -> Response:  # Starlette calls it in a thread
        return Response(file.read_bytes(), media_type=f"{kind}; charset=utf-8", headers={"Cache-Control": "no-cache"})

    return answer


def _make_tile_endpoint(tiles: TileFile) -> Any:
    """Return the endpoint of the tiles of the map."""

    def answer(request: Request) -> Response:
        place = request.path_params
        tile = tiles.get(place["zoom"], place["x"], place["y"])
        if tile is None:
            return Response(status_code=204)
        return Response(tile, media_type=tiles.kind, headers={"Cache-Control": "private, max-age=86400"})

    return answer


def _make_route(workbench: Workbench, route: JsonRoute) -> Route:
    """Return the endpoint of a JSON route."""

    async def answer(request: Request) -> Response:
        try:
            body = await _read_object(request, workbench) if route.changes else {}
            asked = JsonRequest(request.path_params, request.query_params, body)
            record = await run_in_threadpool(route.handle, workbench, asked)
        except _RefusedError as error:
            return _fail(str(error), error.code)
        except NotFoundError as error:
            return _fail(str(error), 404)
        except SocastError as error:
            return _fail(str(error), 422)
        except Exception:  # noqa: BLE001 - a defect must not end the connection
            _log.exception("request failed: %s", request.url.path)
            return _fail("this request failed by a defect; see the log of `socast serve`", 500)
        return Response(_encode(record), media_type="application/json")

    return Route(f"/api{route.path}", answer, methods=["POST" if route.changes else "GET"])


class _RefusedError(Exception):
    """Report a request that is refused before its function is called, with the status code of the answer."""

    def __init__(self, code: int, words: str) -> None:
        super().__init__(words)
        self.code = code


async def _read_object(request: Request, workbench: Workbench) -> dict[str, Any]:
    """Return the JSON object of a request that changes something."""
    if workbench.read_only:
        raise _RefusedError(403, READ_ONLY)
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise _RefusedError(415, "the header Content-Type must be application/json")
    try:
        async with asyncio.timeout(REQUEST_S):
            body = await _read_body(request)
        return msgspec.json.decode(body, type=dict[str, Any])
    except TimeoutError as error:
        raise _RefusedError(408, f"the request is not whole after {REQUEST_S:g} s: send it again") from error
    except UNREADABLE as error:
        raise _RefusedError(400, f"the request holds no JSON object: {error}") from error


async def _read_body(request: Request) -> bytes:
    """Return the body of a request, if it is not too large."""
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > LARGEST_BODY:
            raise _RefusedError(413, f"the request is larger than {LARGEST_BODY:,} bytes: send less")
    return content or b"{}"


def _fail(words: str, code: int) -> Response:
    """Return an error as one JSON line."""
    return Response(_encode({"error": " ".join(words.split())}), code, media_type="application/json")
