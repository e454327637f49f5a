"""`GET /docs`: one page that describes how clients use this server, and loads nothing from the
network.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping
from typing import Any

from vlagents_ray.docstrings import summary_of
from vlagents_ray.errors import BY_CODE
from vlagents_ray.protocol.frames import CONTENT_TYPE
from vlagents_ray.protocol.messages import (
    DEADLINE_HEADER,
    PRIORITY_HEADER,
    REQUEST_ID_HEADER,
    SESSION_HEADER,
    STEP_HEADER,
)

STYLE = """
:root { color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif; }
body { max-width: 52rem; margin: 2rem auto; padding: 0 1rem; }
pre, code { font: 0.9em/1.4 ui-monospace, monospace; }
pre { padding: 0.8rem; overflow-x: auto; border: 1px solid #8884; border-radius: 6px; }
dd { margin: 0 0 0.4rem 1.5rem; }
"""
_CURL = f"""\
curl -H '{SESSION_HEADER}: robot-1' -F 'obs={{"instruction": "push the cube to the goal", "gripper": 1.0}}' \\
     -F 'cameras.front=@front.jpg' http://HOST:8000/v1/reset
curl -H '{SESSION_HEADER}: robot-1' -F 'obs={{"gripper": 1.0, "state": {{"joints": [0, 0, 0, 0, 0, 0, 0]}}}}' \\
     -F 'cameras.front=@front.jpg' http://HOST:8000/v1/act"""
_PYTHON = """\
from vlagents_ray import Obs, RemoteAgent

with RemoteAgent("http://HOST:8000") as agent:
    agent.reset(obs, "push the cube to the goal")
    act = agent.act(obs)"""
# Each entry is one line, followed by its indented description.
_PATHS = f"""\
`POST /v1/reset`, `POST /v1/act`
    `multipart/form-data`: a JSON part `obs` (instruction, gripper, state, info; for reset also kwargs, contract) and a
    JPEG or PNG file `cameras.<name>` for each camera; or `application/json` without cameras; or one frame,
    `{CONTENT_TYPE}`. The answer is JSON, or a frame if `Accept` requests one. Images are upright RGB. A server cannot
    detect swapped colours: convert OpenCV's BGR with `image[..., ::-1]` before it is sent as an array (`cv2.imencode`
    takes BGR as it is), and let `vlagents-ray robot check` compare the colours of a test card.
`POST /v1/close`
    Ends the session.
`WS /v1/stream`
    Binary frames; sessions end with the connection. A message that begins with `VLA?` is a probe.
`GET /v1/metadata`
    Policy, checkpoint, contract, protocol version, and all addresses.
`GET /healthz`
    200 when the policy can act, 503 until then.
"""
_HEADERS = f"""\
`{PRIORITY_HEADER}`
    `robot` (the default) or `simulation`. Requests of robots are served first.
`{DEADLINE_HEADER}`
    Time in milliseconds after which an answer is useless. The request then returns 504. With the code
    `deadline_exceeded`, the policy has not received the request and never will; with `outcome_unknown`, the policy was
    processing it.
`{STEP_HEADER}`
    Each answer contains this header. If you send its value with the next request of the session, that request is
    rejected (404 `unknown_session`) unless the session is still in this state. Otherwise, the request could reach an
    older episode of the session at another replica.
`{REQUEST_ID_HEADER}`
    Id of a request. The answer and the server's log contain the same id.
"""
_TIMING = """\
`decode_ms`
    Decoding of the request, after its last byte has arrived.
`queue_ms`
    Waiting for the policy.
`inference_ms`
    Computation of the batch that contains the request, until the device has finished.
`encode_ms`
    Encoding of the answer.
`total_ms`
    Total time on the server, including the time between these stages.
`batch_size`
    Number of observations in that batch (not a time).
`round_trip_ms`, `wire_ms`
    Added by the client of vlagents_ray: the duration of the whole call, and the part of it outside the server.
"""


def docs_page(metadata: dict[str, Any]) -> str:
    """Return the page as HTML, from the document of `GET /v1/metadata`, in which dialects and
    replica parts have entries.
    """
    policy = html.escape(str(metadata["policy"]))

    dialects = ""
    for dialect in (metadata.get("dialects") or {}).values():
        addresses = ", ".join(dialect.get("paths") or [dialect["address"]])
        dialects += f"`{addresses}`\n    Clients of {dialect['clients']}. {dialect['summary']}\n"

    parts = "".join(map(_entry_of_part, (metadata.get("parts") or {}).values()))

    errors = ""
    for code, error in sorted(BY_CODE.items(), key=lambda item: (item[1].status, item[0])):
        errors += f"{error.status} `{code}`\n    {summary_of(error)}\n"

    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width"><title>vlagents_ray: {policy}</title>
<style>{STYLE}</style></head><body>
<h1>{policy}</h1>
<p>A policy served by vlagents_ray {html.escape(str(metadata["version"]))}, protocol {metadata["protocol"]}.
Choose a session id for each robot or environment and send it as <code>{SESSION_HEADER}</code> with every request:
<code>reset</code> begins an episode, <code>act</code> returns the next action or chunk of actions.</p>
<p>If the server requires an API key, send yours with every request: <code>Authorization: Bearer KEY</code>.</p>
<h2>With curl</h2><pre>{html.escape(_CURL)}</pre>
<h2>With Python</h2><pre>{html.escape(_PYTHON)}</pre>
<h2>Paths</h2>{_entries(_PATHS + parts)}
<p>A replica that stops hands its sessions over to another replica: the next request with the same session id continues the episode.</p>
<h2>Headers</h2>{_entries(_HEADERS)}
{"<h2>Unchanged clients of other systems</h2>" + _entries(dialects) if dialects else ""}
<h2>Timing</h2><p>The answer to <code>act</code> contains these durations in <code>timing</code>:</p>
{_entries(_TIMING)}
<h2>Metrics</h2>
<p>Prometheus reads the metrics at the metrics port of each Ray node, as <code>ray_vlagents_…</code>: requests by op,
transport, priority and outcome; latency; time by stage; batch sizes; queue depth; sessions by transport; utilisation.</p>
<h2>Errors</h2><p><code>application/problem+json</code> with a stable <code>code</code>:</p>
{_entries(errors)}
<h2>This policy</h2><pre>{html.escape(json.dumps(metadata, indent=2))}</pre>
</body></html>"""


def _entry_of_part(facts: Mapping[str, Any]) -> str:
    """Return the entry of a part with these facts, as `ReplicaPart.describe` returns them; empty
    if it has no paths.
    """
    if "summary" not in facts:
        return ""
    paths = list(facts.get("paths", ()))
    if "page" in facts:
        paths.append(f"GET {facts['page']}")
    if not paths:
        return ""
    return ", ".join(f"`{path}`" for path in paths) + f"\n    {facts['summary']}\n"


def _entries(text: str) -> str:
    """Return a list of entries as HTML, from plain text with `code` in backquotes."""
    marked = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
    entries = re.sub(r"(\S.*)\n((?: {4}.*\n)*)", r"<dt>\1</dt>\n<dd>\2</dd>\n", marked)
    return f"<dl>{entries}</dl>"
