"""Golden traces of the request path: the bytes that go in at each endpoint, and those that come
out.

What is recorded. A scenario of `own_protocol` or `dialects` is a list of messages and of events at
the server. It is played at each of its endpoints: shared memory, plasma (its store alone is
replaced by a dict), the WebSocket of a replica's own port and that of `/v1/stream`, HTTP (frames,
documents, forms), the entry point of a Serve handle, and the protocols of openpi, RoboArena,
OpenVLA, vla-eval, GR00T, LeRobot and vlagents. The server, `replica.Server`, is the real engine
with its endpoints and dialects, without Ray, over a policy whose action is a function of what it
saw. The clients of `lines` carry bytes and know nothing of this package; for GR00T and LeRobot,
ZeroMQ and gRPC carry the messages. `traces/FILE.txt` has, for each scenario,

    == its name
    [[the endpoints at which the same bytes go both ways], {the settings of the server}]
    a; sends                the message of line a: ASCII as it is, «hexadecimal», «07*192» for 192
                            times the byte 07
      «564c4101c3000000»{"op":"reset", …
    a; gets; binary         what came, and how: of a WebSocket its opcode, of gRPC the status
      «564c4101e4000000»{"request_id":"r-1", …
    server; drains          an event, see `Server.do`

`endpoints/NAME.txt` is the same for the table of `tests/support/endpoint_situations.py`, which has
each endpoint in each situation: also a wrong key, garbage, half a message, and the stop of the
server. There every byte of a connection is recorded, from the handshake to the end. Its tests are
tests/serve/endpoints/test_golden_bytes.py, and that of the dialects.

A second line of data is what travels outside of the message: what lies in the memory file, or
LeRobot's message beside the method's name. A session that moves is played with two replicas: the
last digit of a line's name counts them.

What is compared. The server is sent the bytes of the file, whatever today's encoders write, and its
answers must have the recorded bytes. A second test has today's encoders write the requests again,
LeRobot's aside. Not compared is what varies by nature, which `masks` replaces by zeros: times in ms
and timestamps, ids that are drawn at random (16 or 32 hexadecimal digits), the headers Date and
Server, the CPU core, and which memory files are free again. A length around such a value is made to
fit. How many digits or bytes a time has is compared, and so is the batch's size. Steps begin at
10**15, since the server gets a wall clock that stands still. Bytes within gRPC's own framing, other
cases of API keys (tests/serve/test_access_matrix.py) and the metadata of a replica under Ray are
not recorded.

A difference is printed by step, in lines of about a field:

    step 3: a gets
    -    "detail":"act before reset: this connection has no session yet; reset first"}
    +    "detail":"reset first"}

When one is allowed. A rewrite of the server changes nothing here; it may only need another
`replica`. A change that clients are meant to see (docs/protocol.md says which are compatible) comes
in a commit of its own: with

    python -m pytest tests/golden --record all

all files are written again, and the commit's diff of `traces` and `endpoints` is what is reviewed:
it has that change and no other. A new scenario is a `yield`, and `--record traces/http` writes its
file alone; for a new endpoint, `--record endpoints/own_port` does. A version of uvicorn, websockets
or Python with other texts is recorded with `all`.
"""
