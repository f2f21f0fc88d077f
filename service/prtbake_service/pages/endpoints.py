"""The page at ``/``.

It holds no secret: the script takes the API key from the URL's fragment, which browsers do not
send, or from a field, and puts it into the header of each request.  So there is no cookie that
another site could make a browser send along.
"""

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse
from starlette.staticfiles import StaticFiles

from prtbake_storage.plots import FRONTIER_SCRIPT

STATIC = Path(__file__).parent / "static"
_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
router = APIRouter(include_in_schema=False)
static_files = StaticFiles(directory=STATIC)


@router.get("/")
def index() -> FileResponse:
    """Give the page."""
    return FileResponse(STATIC / "index.html", headers={"Content-Security-Policy": _POLICY})


@router.get(f"/static/{FRONTIER_SCRIPT.name}")
def frontier_script() -> FileResponse:
    """Give what draws the plot of a study, here and in the page that the study leaves."""
    return FileResponse(FRONTIER_SCRIPT, media_type="text/javascript")
