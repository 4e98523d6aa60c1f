"""The local server: responses and refusals."""

import http.client
import json
import socket
import threading

import cv2
import numpy as np
import pytest

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.viewer.routes import PAGE_FILES, Routes
from robocas_ms3.viewer.server import HOST, Viewer
from robocas_ms3.viewer.source import open_content


@pytest.fixture(scope="module")
def server(folder):
    with Viewer(open_content(folder)) as running:
        threading.Thread(target=running.serve_forever, args=(0.02,), daemon=True).start()
        yield running
        running.shutdown()


def get(server, path, method="GET", host=None):
    connection = http.client.HTTPConnection(HOST, server.server_port, timeout=30)
    connection.putrequest(method, path, skip_host=True)
    connection.putheader("Host", host or f"{HOST}:{server.server_port}")
    connection.endheaders()
    response = connection.getresponse()
    data = response.read()
    connection.close()
    return response, data


def content(data: bytes, name: str):
    head, tail = f'robocas.put("{name}",'.encode(), b");\n"
    assert data.startswith(head)
    assert data.endswith(tail)
    return json.loads(data[len(head) : -len(tail)])


def pixels(data: bytes):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def test_the_page_and_its_files(server):
    response, data = get(server, "/?x=1")
    assert response.status == 200
    assert data.startswith(b"<!doctype html>")
    for name, kind in PAGE_FILES.items():
        response, found = get(server, f"/page/{name}")
        assert (response.status, response.headers["Content-Type"]) == (200, kind)
        assert found
        if name != "index.html":
            assert f"page/{name}".encode() in data, f"{name} is not used"
    assert b"//" not in data.replace(b"://", b"//").split(b"<body>")[0]  # nothing from elsewhere
    assert "default-src 'self'" in response.headers["Content-Security-Policy"]


def test_data(server, folder):
    response, data = get(server, "/data/index.js")
    assert response.headers["Content-Type"].startswith("text/javascript")
    index = content(data, "index")
    assert [row["n"] for row in index["episodes"]] == [0, 1, 2, None]
    assert index["version"] != Routes(server.routes.source).version  # of images that a browser keeps
    assert content(get(server, "/data/index.js")[1], "index") == index
    _, data = get(server, "/data/episode_1.js")
    assert content(data, "episode_1")["steps"] == 7


def test_images(server, folder):
    response, data = get(server, "/images/1/base_camera/rgb/2.jpg")
    assert response.headers["Content-Type"] == "image/png"
    assert data == (folder / "episode_0000001/base_camera/rgb/0002.png").read_bytes()
    response, data = get(server, "/images/1/base_camera/depth/2.jpg")
    assert response.headers["Content-Type"] == "image/jpeg"
    assert pixels(data).shape == (48, 64, 3)
    assert get(server, "/images/1/base_camera/depth/2.jpg?1a2b")[1] == data
    _, data = get(server, "/thumbnails/1.jpg")
    assert pixels(data).shape == (72, 96, 3)


@pytest.mark.parametrize(
    "paths",
    [
        "//etc/passwd /etc/passwd /../../../etc/passwd /page/../routes.py /page/..%2froutes.py /page/%2e%2e/routes.py",
        "/conversion.json /failures.jsonl /episode_0000000/episode_info.npz /page/ /page/server.py /data/index.json",
        "/data/episode_../../x.js /data/episode_-1.js /data/episode_01.js /data/episode_9.js /data/episode_%D9%A1.js",
        "/data/episode_99999999999999999999.js /data/index.js%00 /thumbnails/9.jpg /images/9/base_camera/rgb/0.jpg",
        "/images/0/../rgb/0.jpg /images/0/..%2f..%2fx/rgb/0.jpg /images/0/top_camera/rgb/0.jpg",
        "/images/0/base_camera/mask/0.jpg /images/0/base_camera/rgb/7.jpg /images/0/base_camera/rgb/0.png",
        "/images/0/base_camera/rgb/0.jpg/",
    ],
)
def test_nothing_else_is_served(server, paths):
    for path in paths.split():
        response, data = get(server, path)
        assert response.status == 404, path
        assert b"root:" not in data
        assert response.headers["Content-Type"].startswith("text/plain")


def test_only_for_this_machine(server):
    assert server.server_address[0] == "127.0.0.1"
    for host in ("evil.example", f"evil.example:{server.server_port}", HOST):
        response, data = get(server, "/data/index.js", host=host)
        assert response.status == 403
        assert b"episodes" not in data
    assert get(server, "/", host=f"localhost:{server.server_port}")[0].status == 200


def test_other_methods_are_refused(server):
    for method in ("POST", "PUT", "DELETE"):
        assert get(server, "/data/index.js", method)[0].status == 501
    response, data = get(server, "/data/index.js", "HEAD")
    assert (response.status, data) == (200, b"")
    assert int(response.headers["Content-Length"]) > 100


def test_server_stops_with_open_connections(folder):
    before = set(threading.enumerate())
    with Viewer(open_content(folder)) as server:
        server.warm_up()
        serving = threading.Thread(target=server.serve_forever, args=(0.02,))
        serving.start()
        connection = http.client.HTTPConnection(HOST, server.server_port, timeout=30)
        connection.request("GET", "/thumbnails/0.jpg")
        connection.getresponse().read()
        server.shutdown()
        serving.join()
    assert set(threading.enumerate()) <= before
    assert connection.sock is not None
    assert connection.sock.recv(1) == b""
    connection.close()


def test_the_number_of_connections_is_bounded(folder, monkeypatch):
    monkeypatch.setattr("robocas_ms3.viewer.server.MAX_CONNECTIONS", 2)
    with Viewer(open_content(folder)) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        address = HOST, server.server_port
        connect = socket.create_connection
        with connect(address), connect(address), connect(address, timeout=20) as third:
            assert third.recv(1) == b""
        server.shutdown()


def test_request_errors_are_printed_without_control_characters(server, capsys):
    try:
        raise ValueError("a\x1b[2Jb")
    except ValueError:
        server.handle_error(None, None)
    assert "a\\u001b[2Jb" in (shown := capsys.readouterr().err)
    assert "\x1b" not in shown


def test_used_port(folder):
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        with pytest.raises(RobocasError, match="can't be used"):
            Viewer(open_content(folder), taken.getsockname()[1])
    with pytest.raises(RobocasError, match="can't be used"):
        Viewer(open_content(folder), 70_000)
