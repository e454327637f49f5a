"""`GET /docs`: how to talk to this server, in one page that needs no network."""

from __future__ import annotations

import html
import json
from typing import Any

from vlagents_ray.errors import BY_CODE
from vlagents_ray.wire.frames import CONTENT_TYPE
from vlagents_ray.wire.messages import DEADLINE_HEADER, RANK_HEADER, REQUEST_ID_HEADER, SESSION_HEADER

_STYLE = """
:root { color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif; }
body { max-width: 52rem; margin: 2rem auto; padding: 0 1rem; }
pre, code { font: 0.9em/1.4 ui-monospace, monospace; }
pre { padding: 0.8rem; overflow-x: auto; border: 1px solid #8884; border-radius: 6px; }
td, th { text-align: left; padding: 0.2rem 1rem 0.2rem 0; vertical-align: top; }
"""
_DIALECTS = {"openpi": "openpi", "roboarena": "RoboArena", "openvla": "OpenVLA", "vla_eval": "vla-eval"}
_TIMING = (
    ("decode_ms", "the request, whose last byte is here, out of its bytes"),
    ("queue_ms", "waiting for the policy"),
    ("inference_ms", "the batch that it was in, until the device was done"),
    ("encode_ms", "the answer into bytes"),
    ("total_ms", "all of that and what lies between, on the server"),
    ("batch_size", "observations in that batch; no time"),
    (
        "round_trip_ms, wire_ms",
        "added by our client: the whole, and what of it was not the server's",
    ),
)


def docs_page(metadata: dict[str, Any]) -> str:
    """The page as HTML."""
    errors = "".join(
        f"<tr><td>{cls.status}</td><td><code>{code}</code></td><td>{html.escape(_first_line(cls))}</td></tr>"
        for code, cls in sorted(BY_CODE.items(), key=lambda item: (item[1].status, item[0]))
    )
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width"><title>vlagents_ray: {html.escape(str(metadata["policy"]))}</title>
<style>{_STYLE}</style></head><body>
<h1>{html.escape(str(metadata["policy"]))}</h1>
<p>A policy served by vlagents_ray {html.escape(str(metadata["version"]))}, protocol {metadata["protocol"]}.
Choose a session id for each robot or environment and send it as <code>{SESSION_HEADER}</code> with every request:
<code>reset</code> begins an episode, <code>act</code> gives the next action or chunk of actions.</p>
<p>Where the server has API keys, send yours with every request: <code>Authorization: Bearer KEY</code>.</p>
<h2>With curl</h2>
<pre>curl -H '{SESSION_HEADER}: robot-1' -F 'obs={{"instruction": "push the cube to the goal", "gripper": 1.0}}' \\
     -F 'cameras.front=@front.jpg' http://HOST:8000/v1/reset
curl -H '{SESSION_HEADER}: robot-1' -F 'obs={{"gripper": 1.0, "state": {{"joints": [0, 0, 0, 0, 0, 0, 0]}}}}' \\
     -F 'cameras.front=@front.jpg' http://HOST:8000/v1/act</pre>
<h2>With Python</h2>
<pre>from vlagents_ray import Obs, RemoteAgent

with RemoteAgent("http://HOST:8000") as agent:
    agent.reset(obs, "push the cube to the goal")
    act = agent.act(obs)</pre>
<h2>Paths</h2>
<table>
<tr><td><code>POST /v1/reset</code>, <code>POST /v1/act</code></td><td><code>multipart/form-data</code>: a JSON part
<code>obs</code> (instruction, gripper, state, info; for reset also kwargs, contract) and a JPEG or PNG file
<code>cameras.&lt;name&gt;</code> for each camera; or <code>application/json</code> without cameras; or one frame,
<code>{CONTENT_TYPE}</code>. The answer is JSON, or a frame if <code>Accept</code> asks for it.</td></tr>
<tr><td><code>POST /v1/close</code></td><td>Ends the session.</td></tr>
<tr><td><code>WS /v1/stream</code></td><td>Binary frames; sessions end with the connection. A message that begins with
<code>VLA?</code> is a probe.</td></tr>
<tr><td><code>POST /v1/probe</code></td><td>For measuring the link: <code>VLA?</code>, four zero bytes and any others,
which reach neither a session nor the policy. The answer, at once, is <code>VLA!</code> and the number of bytes, 64
bits, little-endian. With a one in place of the first zero, a frame follows, which is decoded first.</td></tr>
<tr><td><code>GET /v1/metadata</code></td><td>Policy, checkpoint, contract, protocol version.</td></tr>
<tr><td><code>GET /healthz</code></td><td>200 when the policy can act, 503 until then.</td></tr>
{_dialects(metadata)}</table>
<p>A replica that stops hands its sessions over: the next request of the same session id goes on where it was.</p>
<p>Headers: <code>{RANK_HEADER}</code>, <code>robot</code> (the default, goes first) or <code>simulation</code>;
<code>{DEADLINE_HEADER}</code>, after which an answer is useless (504, and the request is dropped if it has
not begun); <code>{REQUEST_ID_HEADER}</code>, which comes back with the answer and stands in the server's log.</p>
<h2>Timing</h2>
<p>The answer to <code>act</code> says where the milliseconds went, in <code>timing</code>:</p>
<table>{"".join(f"<tr><td><code>{name}</code></td><td>{text}</td></tr>" for name, text in _TIMING)}</table>
<h2>Metrics</h2>
<p>Prometheus reads them at the metrics port of each Ray node, as <code>ray_vlagents_…</code>: requests by op,
transport, class and outcome, latency, time by stage, batch sizes, queue depth, sessions by transport, utilisation.</p>
<h2>Errors</h2>
<p><code>application/problem+json</code> with a stable <code>code</code>:</p>
<table><tr><th>Status</th><th>Code</th><th>Meaning</th></tr>{errors}</table>
<h2>This policy</h2>
<pre>{html.escape(json.dumps(metadata, indent=2))}</pre>
</body></html>"""


def _dialects(metadata: dict[str, Any]) -> str:
    """Rows of the table of paths; the mappings stand in the metadata."""
    return "".join(
        f"<tr><td><code>{html.escape(', '.join(one['paths']))}</code></td><td>Clients of {_DIALECTS.get(name, name)}, "
        f"as they are.</td></tr>\n"
        for name, one in (metadata.get("dialects") or {}).items()
    )


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").strip().partition("\n")[0]
