"""The live page's server, by requests."""

import http.client
import json
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from sb3_momba.explorer.kit import DecisionKit
from sb3_momba.explorer.live import LiveServer, NewestFirst, SupersededError, is_loopback, listen
from sb3_momba.explorer.opening import open_kit
from tests.explorer_runs import fail, serving, train_tiny


@pytest.fixture(scope="module")
def kit(tmp_path_factory) -> Iterator[DecisionKit]:
    folder = tmp_path_factory.mktemp("live")
    with open_kit(train_tiny(folder / "run"), folder=folder / "kept", films=False) as kit:
        yield kit


@pytest.fixture(scope="module")
def server(kit) -> Iterator[LiveServer]:
    with serving(kit) as server:
        yield server


def request(
    server: LiveServer, path: str, body: Any = None, headers: dict[str, str] | None = None
) -> tuple[int, dict[str, str], bytes]:
    """A GET, or with a body a POST."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=60)
    content = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
    given = {"Content-Type": "application/json", **(headers or {})}
    connection.request("GET" if body is None else "POST", path, content, given)
    answer = connection.getresponse()
    result = answer.status, dict(answer.headers), answer.read()
    connection.close()
    return result


def error_of(answer: tuple[int, dict[str, str], bytes]) -> tuple[int, str]:
    return answer[0], json.loads(answer[2])["error"]


def test_the_page_is_served_with_a_policy_of_its_own(server):
    status, headers, content = request(server, "/")
    assert status == 200
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert b"http" not in content.replace(b'"http', b"")


@pytest.mark.parametrize("path", ["/../record.jsonl", "/..%2f..%2fetc/passwd", "/etc/passwd", "//etc/passwd", "/live.py"])
def test_no_other_file_is_served(path, server):
    assert error_of(request(server, path)) == (404, "There is no such page.")


def test_only_the_page_is_answered(server):
    question = {"preference": [0.5, 0.5]}
    port = server.server_address[1]
    assert request(server, "/predict", question, {"Origin": f"http://127.0.0.1:{port}"})[0] == 200
    assert request(server, "/predict", question, {"Host": f"localhost:{port}"})[0] == 200
    assert request(server, "/", None, {"Host": "evil.example"})[0] == 403
    assert request(server, "/predict", question, {"Host": f"evil.example:{port}"})[0] == 403
    assert request(server, "/predict", question, {"Origin": "http://evil.example"})[0] == 403
    assert request(server, "/predict", question, {"Content-Type": "text/plain"})[0] == 415
    assert request(server, "/predict", b"x" * 70_000)[0] == 413
    assert request(server, "/predict", b"x", {"Content-Length": "9" * 5_000})[0] == 413
    assert request(server, "/predict")[0] == 404


@pytest.mark.parametrize(
    ("path", "question", "words"),
    [
        ("/predict", b"{", "Expecting"),
        ("/predict", b"[" * 60_000, "no JSON"),
        ("/predict", [], "no JSON object"),
        ("/predict", {}, "give a list of 2 weights"),
        ("/predict", {"preference": "x"}, "give a list of 2 weights"),
        ("/predict", {"preference": [[0.5, 0.5]]}, "give a list of 2 weights"),
        ("/predict", {"preference": [1, 1]}, "sums to 2"),
        ("/predict", {"preference": [2, -1]}, "negative"),
        ("/predict", {"preference": [1, 0, 0]}, "2 weights"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 2, "less": 1}, "from 0 to 1"),
        ("/bound", {"preference": [0.5, 0.5], "objective": True, "less": 1}, "from 0 to 1"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 0}, "one of at_least and less"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 0, "less": -1}, "0 or more"),
        ("/bound", {"preference": [0.5, 0.5], "objective": 0, "at_least": "x"}, "give a number"),
        ("/keep", {"preference": ["../x", 1]}, "not an array"),
    ],
    ids=[
        *["no JSON", "too deep", "a list", "nothing", "a word", "a table", "too much", "negative", "too many"],
        *["no such objective", "a flag", "no bound", "a negative one", "a bound in words", "a path"],
    ],
)
def test_bad_questions_are_refused(path, question, words, server):
    status, error = error_of(request(server, path, question))
    assert status == 400
    assert words in error


@pytest.mark.parametrize(
    "error", [KeyError("joint"), AssertionError(), ValueError("inside")], ids=lambda error: type(error).__name__
)
def test_what_fails_inside_is_no_fault_of_the_question(error, server, kit, monkeypatch, caplog):
    def fail(*_):
        raise error

    monkeypatch.setattr(kit, "show_rollout", fail)
    answer = request(server, "/rollout", {"preference": [0.5, 0.5]})
    assert error_of(answer) == (500, f"{type(error).__name__}: {error}")
    assert "/rollout failed." in caplog.text


def test_a_model_that_was_written_anew_is_not_rolled_out(server, kit):
    path = kit.run.policy.path
    before = path.stat()
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000_000))
    answer = request(server, "/rollout", {"preference": [0.123, 0.877]})
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    status, error = error_of(answer)
    assert status == 500
    assert f"{path} was written anew" in error


def test_predictions_come_in_time(server):
    """Under 100 ms: the median of 20, as this machine may be busy."""
    seconds = []
    for weight in np.linspace(0, 1, 20):
        start = time.perf_counter()
        status, _, _ = request(server, "/predict", {"preference": [weight, 1 - weight]})
        seconds.append(time.perf_counter() - start)
        assert status == 200
    assert np.median(seconds) < 0.1


def test_of_those_that_wait_only_the_newest_gets_its_turn():
    queue, done = NewestFirst(), []
    started, release = threading.Event(), threading.Event()

    def wish(name: str) -> None:
        try:
            with queue.turn() as still_wanted:
                started.set()
                release.wait()
                done.append(name)
                still_wanted()
        except SupersededError:
            done.append(f"{name} superseded")

    threads = [threading.Thread(target=wish, args=(name,)) for name in ("first", "second", "third")]
    threads[0].start()
    started.wait()
    for newest, thread in enumerate(threads[1:], start=2):
        thread.start()
        while queue._newest != newest:
            time.sleep(0.001)
    release.set()
    for thread in threads:
        thread.join()
    assert done[:2] == ["first", "first superseded"]
    assert sorted(done[2:]) == ["second superseded", "third"]


def test_rollouts_asked_for_at_once_are_whole(server, kit):
    """Some are superseded; those that are answered have the numbers of the evaluation."""
    kit._rollouts.clear()
    answers: dict[int, dict[str, Any]] = {}

    def ask(k: int) -> None:
        answers[k] = json.loads(request(server, "/rollout", {"preference": kit.front.preferences[k].tolist()})[2])

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(len(kit.front.preferences))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    answered = {k: answer for k, answer in answers.items() if not answer.get("superseded")}
    assert answered
    for k, answer in answered.items():
        np.testing.assert_allclose(answer["discounted"], kit.measured[k])


def test_a_port_in_use_is_named_before_anything_is_rolled_out(server, kit):
    port = server.server_address[1]
    fail(["live", kit.run.record.path.parent, "--port", port], rf"127.0.0.1:{port} cannot be listened on \(.*\): try --port 0")
    fail(
        ["live", kit.run.record.path.parent, "--port", 70_000],
        "--port 70000: give a number from 1 to 65535, or 0 for a free port",
    )
    with pytest.raises(OSError, match=r"^[^()]*\(Address already in use\): try --port 0.$"):
        listen("127.0.0.1", port)


def test_a_host_that_is_not_this_machine_is_named():
    with pytest.raises(OSError, match=r"--host nowhere\.invalid is no name or address that is known here"):
        listen("nowhere.invalid", 0)
    with pytest.raises(OSError, match=r"--host 192\.0\.2\.1 is no address of this machine"):
        listen("192.0.2.1", 0)


def test_everyone_is_let_in_with_a_warning_only(caplog, tmp_path):
    fail(["live", tmp_path, "--host", "0.0.0.0", "--port", "0"], "has no record.jsonl")
    assert "--host 0.0.0.0 lets everyone who reaches this machine" in caplog.text


def test_other_addresses_than_loopback_are_told_apart():
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert [is_loopback(host) for host in ("0.0.0.0", "192.168.0.2", "example.org")] == [False] * 3
