"""A small published sequence, packed and served."""

import pytest
from helpers.fetch_server import FOLDER, NAME, Server, tgz
from helpers.sequence_folders import make_folder

from dynslam_bench.sequences.fetch import fetch


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made, *_ = make_folder(
        tmp_path_factory.mktemp("published") / FOLDER, frames=4, width=640, height=480
    )
    (made / "camera.toml").unlink()
    return made


@pytest.fixture(scope="module")
def packed(folder):
    return tgz(folder)


@pytest.fixture
def server(packed):
    made = Server(packed)
    yield made
    made.close()


@pytest.fixture
def get(server, tmp_path):
    """Fetches from the server into a fresh root, without waiting between attempts."""

    def call(**how):
        return fetch(
            NAME, data_root=tmp_path / "root", url=server.url, wait_s=0.0, timeout_s=5.0, **how
        )

    return call
