import pytest

from prtbake_storage.blobs.opening import open_store
from support.scenes import asset_request, run_asset, teapot_context


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    return open_store((tmp_path_factory.mktemp("jobs") / "blobs").as_uri())


@pytest.fixture(scope="session")
def glossy_asset(store):
    """Request, context and results of a glossy teapot on a plane, through every stage."""
    request = asset_request()
    context = teapot_context(store, request, 3)
    return request, context, run_asset(store, request, context)
