"""The dashboard as a web application: addresses and their answers."""

import platform
import re
from base64 import b64encode
from collections.abc import Callable
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import anyio
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.queue.job_queue import JobQueue
from pipeline.queue.states import JobState
from pipeline.show.report.chart import scripts
from pipeline.store.receipts import read_receipt
from pipeline.web.auth import Access, Gate, form_of
from pipeline.web.dashboard.actions import Queue, actions_of
from pipeline.web.dashboard.farm_view import FarmView, JobCard, Kept
from pipeline.web.dashboard.job_view import LONGEST_TEXT, STATE_GROUPS, Question, film_of, look_at_job
from pipeline.web.dashboard.machine import Machine
from pipeline.web.dashboard.pages import FARM_PARTS, JOB_PARTS, Pages, Part, job_url
from pipeline.web.dashboard.places import NotThereError, Places, printable
from pipeline.web.dashboard.thumbnails import WIDTHS, Thumbnails

THUMBNAILS_AT_ONCE = 2
"""Drawn beside each other: the cores are the farm's."""
SETTLED_SHOWN = 24
"""So many finished jobs are listed before "show all"."""
FOR_EVER = "private, max-age=31536000, immutable"
FRAME_NUMBER = re.compile("[0-9]{1,9}")


@cache
def report_policy() -> str:
    """What a report may do: it carries its own style, pictures and film, and lies in a job's folder, which may be made
    by others. So no script of it is run but those that every report has, to the letter, and these reach nothing.
    """
    ours = " ".join(f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" for text in scripts())
    return (
        f"default-src 'none'; script-src {ours}; style-src 'unsafe-inline'; img-src data:; media-src data:; "
        "frame-ancestors 'none'; sandbox allow-scripts"
    )


class Dashboard:
    """The pages of one farm."""

    def __init__(self, farm: Path, access: Access) -> None:
        """`farm` is the folder that holds the jobs' folders; it is there."""
        self.access = access
        self.places = Places(farm)
        self.queue = Queue(JobQueue(farm.absolute()))
        self.view = FarmView(self.places, self.queue.spool)
        self.machine = Machine(self.places.farm)
        self.pages = Pages()
        self._load = Kept(self.machine.load)
        self._thumbnails = Thumbnails()
        self._limiter = anyio.CapacityLimiter(THUMBNAILS_AT_ONCE)
        self._shown = str(farm)
        self.view.glance()

    def application(self) -> ASGIApp:
        """The application, behind its gate."""
        routes = [
            Route("/", self.farm_page),
            Route("/parts", self.farm_parts),
            Route("/work", self.work, methods=["POST"]),
            Route("/static/{name}", self.static),
            Route("/jobs/{name}", self.job_page),
            Route("/jobs/{name}/parts", self.job_parts),
            Route("/jobs/{name}/frames/{frame}/{size}", self.frame),
            Route("/jobs/{name}/film", self.film),
            Route("/jobs/{name}/report", self.report),
            Route("/jobs/{name}/{action}", self.action, methods=["POST"]),
        ]
        handlers = dict.fromkeys((HTTPException, PipelineError, OSError), self._error)
        app = Starlette(routes=routes, exception_handlers=handlers)
        app.router.redirect_slashes = False
        return Gate(app, self.access, refuse=self._message, ask=self._ask, welcome=self._welcome)

    # --- pages ---
    def farm_page(self, request: Request) -> Response:
        """All jobs."""
        return self._page(request, "farm.html", self._farm(request), find=_asked_name(request))

    def farm_parts(self, request: Request) -> Response:
        """Parts of that page that have changed."""
        return _changed(request, self._farm(request))

    def job_page(self, request: Request) -> Response:
        """One job."""
        name = request.path_params["name"]
        parts = self._job(request)
        question = Question.of(request.query_params)
        stages = [stage.name for stage in self.view.job(name).record.stages]
        return self._page(request, "job.html", parts, name=name, question=question, stages=stages, groups=STATE_GROUPS)

    def job_parts(self, request: Request) -> Response:
        """Parts of that page that have changed."""
        return _changed(request, self._job(request))

    def _page(self, request: Request, template: str, parts: dict[str, Part], **context: Any) -> Response:
        return HTMLResponse(self.pages.draw(template, parts=parts, **self._common(request), **context))

    def _farm(self, request: Request) -> dict[str, Part]:
        glance, find = self.view.glance(), _asked_name(request)
        show_all = "all" in request.query_params or bool(find)
        has_runner = glance.runner is not None or self.queue.is_starting
        settled = [job for job in glance.jobs if job.state in (JobState.DONE, JobState.UNKNOWN) and job.entry is None]
        hidden = set() if show_all else {job.name for job in settled[SETTLED_SHOWN:]}
        return self.pages.parts(
            FARM_PARTS,
            groups=_grouped(
                [job for job in glance.jobs if job.name not in hidden and find.casefold() in job.name.casefold()]
            ),
            find=find,
            hidden=len(hidden),
            actions={job.name: actions_of(job, has_runner=has_runner) for job in glance.jobs},
            flaws=glance.flaws,
            **self._status(request),
        )

    def _job(self, request: Request) -> dict[str, Part]:
        card = self.view.job(request.path_params["name"])
        detail = look_at_job(self.places, card, Question.of(request.query_params))
        has_runner = self.view.glance().runner is not None or self.queue.is_starting
        return self.pages.parts(
            JOB_PARTS,
            job=card,
            detail=detail,
            question=detail.question,
            actions={card.name: actions_of(card, has_runner=has_runner)},
            processes=self.machine.processes(card.holder),
            **self._status(request),
        )

    def _status(self, request: Request) -> dict[str, Any]:
        glance = self.view.glance()
        return {
            "load": self._load.get(),
            "host": platform.node(),
            "runner": glance.runner,
            "starting": self.queue.is_starting,
            "stranded": glance.stranded,
            **self._common(request),
        }

    def _common(self, request: Request) -> dict[str, Any]:
        return {"farm": self._shown, "form_token": self.access.form_token(request.scope["session"])}

    # --- files ---
    def static(self, request: Request) -> Response:
        """A file that every page uses."""
        found = self.pages.static.get(request.path_params["name"])
        if found is None:
            raise HTTPException(404)
        return _tagged(request, found.tag, found.media_type, lambda: found.content)

    async def frame(self, request: Request) -> Response:
        """A small version of a committed frame, as WebP."""
        name, size, number = (request.path_params[each] for each in ("name", "size", "frame"))
        if size not in WIDTHS or not FRAME_NUMBER.fullmatch(number):
            raise HTTPException(404)
        answer = partial(self._frame, request, name, int(number), size)
        return await anyio.to_thread.run_sync(answer, limiter=self._limiter)

    def _frame(self, request: Request, name: str, frame: int, size: str) -> Response:
        artifact = JobLayout.picture(frame)
        layout = JobLayout(self.places.job(name))
        self.places.file(name, layout.receipt(artifact).relative_to(layout.root).as_posix())
        if read_receipt(layout, artifact) is None:  # without one it may be half a frame
            raise NotThereError(f"frame {frame} of {name} is not there")
        path = self.places.file(name, artifact)
        tag = self._thumbnails.tag(path, size)
        return _tagged(request, tag, "image/webp", lambda: self._thumbnails.get(path, size))

    def film(self, request: Request) -> Response:
        """The film, or its part so far, whole or in ranges."""
        name = request.path_params["name"]
        film = film_of(self.places, self.view.job(name))
        if film is None:
            raise NotThereError(f"{name} has no film yet")
        path = self.places.file(name, film.path)
        saved = f"{name}{'' if film.finished else '-so-far'}{path.suffix}"
        return FileResponse(
            path,
            filename=saved,
            content_disposition_type="attachment" if "save" in request.query_params else "inline",
            headers={"cache-control": "private, no-cache"},
        )

    def report(self, request: Request) -> Response:
        """The job's report, in which nothing but its own charts is run."""
        layout = JobLayout(self.places.job(request.path_params["name"]))
        path = self.places.file(request.path_params["name"], layout.report.name)
        return FileResponse(path, media_type="text/html", headers={"content-security-policy": report_policy()})

    # --- actions ---
    async def action(self, request: Request) -> Response:
        """Ask something of a job."""
        name, action = request.path_params["name"], request.path_params["action"]
        form = await self._own_form(request)

        def ask() -> str:
            self.view.job(name)
            return self.queue.act(name, action, form.get("value", ""))

        return await self._answer(request, ask, job_url(name))

    async def work(self, request: Request) -> Response:
        """Run the queue."""
        await self._own_form(request)
        return await self._answer(request, lambda: f"the queue runs{self.queue.run()}", "/")

    async def _own_form(self, request: Request) -> dict[str, str]:
        form = await form_of(request)
        if not self.access.is_form_token(request.scope["session"], form.get("form_token", "")):
            raise HTTPException(403, "the dashboard was started anew; load the page again")
        return form

    async def _answer(self, request: Request, ask: Callable[[], str], page: str) -> Response:
        sentence = await run_in_threadpool(ask)
        self.view.kept.forget()
        if _wants_json(request):
            return JSONResponse({"message": sentence})
        return RedirectResponse(page, 303)

    # --- what went wrong ---
    def _message(self, request: Request, status: int, sentence: str) -> Response:
        if _wants_json(request):
            return JSONResponse({"message": printable(sentence)}, status)
        return HTMLResponse(self.pages.draw("message.html", status=status, sentence=sentence, farm=""), status)

    def _ask(self, request: Request, sentence: str) -> Response:
        if _wants_json(request):
            return JSONResponse({"message": "this session has ended; load the page again"}, 401)
        return HTMLResponse(self.pages.draw("enter.html", sentence=sentence, farm=""), 401)

    def _welcome(self, _request: Request) -> Response:
        return HTMLResponse(self.pages.draw("welcome.html", farm=""))

    def _error(self, request: Request, error: Exception) -> Response:
        if isinstance(error, HTTPException):
            return self._message(request, error.status_code, error.detail)
        if isinstance(error, OSError):
            return self._message(request, 503, f"the farm's disk: {error.strerror or error}")
        return self._message(request, 404 if isinstance(error, NotThereError) else 409, str(error))


def _asked_name(request: Request) -> str:
    """The part of a job's name that is looked for; "" for none."""
    return request.query_params.get("find", "").strip()[:LONGEST_TEXT]


def _grouped(jobs: list[JobCard]) -> list[tuple[str, list[JobCard]]]:
    """The jobs under headings, empty ones left out."""
    headings = {
        "Running": (JobState.RUNNING, JobState.PAUSING),
        "Waiting": (JobState.QUEUED,),
        "Need attention": (JobState.FAILED, JobState.PAUSED, JobState.INTERRUPTED, JobState.UNKNOWN),
        "Not started": (JobState.RECORDED, JobState.NOT_STARTED),
        "Stopped": (JobState.STOPPED,),
        "Done": (JobState.DONE,),
    }
    groups = [(heading, [job for job in jobs if job.state in states]) for heading, states in headings.items()]
    return [(heading, members) for heading, members in groups if members]


def _changed(request: Request, parts: dict[str, Part]) -> Response:
    """The parts that the page does not have yet, as it names those that it has; 204 if it has them all."""
    known = dict(each.partition("=")[::2] for each in request.headers.get("known-parts", "").split(",") if each)
    new = {name: {"tag": part.tag, "html": part.html} for name, part in parts.items() if known.get(name) != part.tag}
    return JSONResponse({"parts": new}) if new else Response(status_code=204)


def _tagged(request: Request, tag: str, media_type: str, content: Callable[[], bytes]) -> Response:
    """A file that is kept by browsers; its address names its version, or its tag tells whether it has changed."""
    kept = FOR_EVER if request.url.query else "private, no-cache"
    headers = {"etag": f'"{tag}"', "cache-control": kept}
    if f'"{tag}"' in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(content(), media_type=media_type, headers=headers)


def _wants_json(request: Request) -> bool:
    return "application/json" in request.headers.get("accept", "")
