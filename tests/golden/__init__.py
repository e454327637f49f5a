"""Golden traces of the request path: the recorded bytes of requests and answers at each endpoint.

What is recorded. A scenario of `own_protocol` or `dialects` is a list of messages and of events at
the server. It runs at each of its endpoints: shared memory, plasma (only its store is replaced by a
dict), the WebSockets of a replica's own port and of `/v1/stream`, HTTP (frames, documents, forms),
the entry point of a Serve handle, and the protocols of openpi, RoboArena, OpenVLA, vla-eval, GR00T,
LeRobot and vlagents. The server, `replica.Server`, is the real engine with its endpoints and
dialects, without Ray, and with a policy whose action is a function of its input. The clients in
`lines` carry bytes and use no code of this package; for GR00T and LeRobot, ZeroMQ and gRPC carry
the messages. For each scenario, `traces/FILE.txt` contains

    == its name
    [[the endpoints with the same bytes in both directions], {the settings of the server}]
    a; sends                the message of line a: ASCII as it is, «hexadecimal», «07*192» for 192
                            times the byte 07
      «564c4101c3000000»{"op":"reset", …
    a; gets; binary         the answer and its kind: a WebSocket's opcode, or gRPC's status
      «564c4101e4000000»{"request_id":"r-1", …
    server; drains          an event, see `Server.do`

`endpoints/NAME.txt` has the same format. It contains the table of
`tests/support/endpoint_situations.py`, which has each endpoint in each situation, including a wrong
key, garbage, half a message, and the stop of the server. Every byte of these connections is
recorded, from the handshake to the end. The tests are tests/serve/endpoints/test_golden_bytes.py,
and the file of the same name for the dialects.

A second line of data is data outside of the message: the content of the memory file, or LeRobot's
message, which follows the method's name. A session that moves is recorded with two replicas: the
last digit of a line's name is the number of the replica.

What is compared. The test sends the bytes of the file, independent of today's encoders, and the
answers must be equal to the recorded bytes. A second test compares the requests that today's
encoders write, except for LeRobot. `masks` replaces values that differ in each run by zeros: times
in ms and timestamps, random ids (16 or 32 hexadecimal digits), the headers Date and Server, the CPU
core, and the list of free memory files. A length around such a value is adjusted. The number of
digits or bytes of a time is compared, and so is the batch's size. Steps begin at 10**15, since the
server gets a wall clock that stands still. Bytes within gRPC's own framing, other cases of API keys
(tests/serve/test_access_matrix.py) and the metadata of a replica under Ray are not recorded.

A difference is printed by step, with about one field per line:

    step 3: a gets
    -    "detail":"act before reset: this connection has no session yet; reset first"}
    +    "detail":"reset first"}

When a difference is allowed. A rewrite of the server must not change the traces; it may only need
another `replica`. A change that clients are meant to see (docs/protocol.md lists the compatible
ones) is a separate commit. The command

    python -m pytest tests/golden --record all

writes all files again, and the reviewer of the commit checks that the diff of `traces` and
`endpoints` contains this change and no other. To add a scenario, add a `yield`; `--record
traces/http` then writes only its file, or `--record endpoints/own_port` the file of a new endpoint.
After an update of uvicorn, websockets or Python that changes texts, record `all`.
"""
