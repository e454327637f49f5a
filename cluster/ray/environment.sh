# What `ray start` and whatever talks to the cluster find in their environment: `. environment.sh` on every machine.

# Nobody joins or commands the cluster without the token in ~/.ray/auth_token.
export RAY_AUTH_MODE=token
# HAProxy is Serve's ingress: a request goes from it straight to a replica, not through a Python proxy.
export RAY_SERVE_ENABLE_HA_PROXY=1
# An HTTP session stays on its replica by its header; whoever sends no headers is cut off after 15 s, and a WebSocket's
# silence is the replica's business. (Serve copies the value into HAProxy's settings, so further lines come with it.)
export RAY_SERVE_HAPROXY_BALANCE_ALGORITHM='hdr(x-session-id)
    hash-type consistent sdbm avalanche
    timeout http-request 15s
    timeout tunnel 24h
'
# s that a client may stand still in the middle of a request.
export RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S=60
# When replicas change, a new HAProxy takes over; the old one keeps its WebSockets this long (Serve's default: 120 s).
export RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S=86400
# s that a replica waits before it stops, for HAProxy to hear of it.
export RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S=1
# Ray gives its workers a low priority; a policy is not to wait for whatever else the machine runs.
export RAY_worker_niceness=0
export RAY_USAGE_STATS_ENABLED=0
