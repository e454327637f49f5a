# What `ray start` and whatever talks to the cluster find in their environment: `. environment.sh` on every machine.

# Only holders of the token in ~/.ray/auth_token join or command the cluster. Ray writes the file with the permissions of
# the umask, and copies may lose theirs: no other account of this machine may read it.
export RAY_AUTH_MODE=token
if [ -e ~/.ray/auth_token ]; then
  chmod go= ~/.ray/auth_token
fi
# HAProxy is Serve's ingress: a request goes from it straight to a replica, not through a Python proxy.
export RAY_SERVE_ENABLE_HA_PROXY=1
# An HTTP session stays on its replica by its header; whoever sends no headers is cut off after 5 s, and a WebSocket's
# silence is the replica's business. (Serve copies the value into HAProxy's settings, so further lines come with it.)
export RAY_SERVE_HAPROXY_BALANCE_ALGORITHM='hdr(x-session-id)
    hash-type consistent sdbm avalanche
    timeout http-request 5s
    timeout tunnel 24h
'
# HAProxy's files, and the socket by which Serve commands it, are in a folder that no other user of the machine enters:
# in Serve's own place, /tmp/haproxy-serve, anybody could have HAProxy send robots elsewhere. (Short, since the names of
# sockets are limited; if the folder is not this user's alone, a new one.)
haproxy_files=/tmp/vlr-haproxy-$(id -u)
mkdir -m 700 "$haproxy_files" 2>/dev/null || true
if [ -z "$(find "$haproxy_files" -maxdepth 0 -type d -uid "$(id -u)" -perm 700 2>/dev/null)" ]; then
  haproxy_files=$(mktemp -d /tmp/vlr-haproxy-XXXXXX)
fi
export RAY_SERVE_HAPROXY_SOCKET_PATH=$haproxy_files/admin
export RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH=$haproxy_files/metrics
export RAY_SERVE_HAPROXY_CONFIG_FILE_LOC=$haproxy_files/haproxy.cfg
export RAY_SERVE_HAPROXY_SERVER_STATE_BASE=$haproxy_files
export RAY_SERVE_HAPROXY_SERVER_STATE_FILE=$haproxy_files/server-state
# It is started by a program of ours, if it is installed: each request is answered within 2 s while no replica runs, where
# Serve would keep it until one does. (It needs the Python environment; what Python says here is why it has none.)
haproxy_program=$(python3 -m vlagents_ray.serve.launch.haproxy "$haproxy_files" || true)
if [ -n "$haproxy_program" ]; then
  export RAY_SERVE_HAPROXY_BINARY_PATH=$haproxy_program
fi
unset haproxy_files haproxy_program
# s that a client may stand still in the middle of a request.
export RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S=60
# When replicas change, a new HAProxy takes over; the old one keeps its WebSockets this long (Serve's default: 120 s).
export RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S=86400
# How often Serve looks whether HAProxy lives; after three failures it starts it again.
export RAY_SERVE_PROXY_HEALTH_CHECK_PERIOD_S=0.5
# How often HAProxy asks a replica whether it lives, and how long that may take; after three failures in a row it gets no
# new connections.
export RAY_SERVE_HAPROXY_HEALTH_CHECK_INTER=500ms
export RAY_SERVE_HAPROXY_HEALTH_CHECK_FALL=3
# s that a replica waits before it stops, for HAProxy to hear of it.
export RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S=1
# Ray gives its workers a low priority; a policy is not to wait for whatever else the machine runs.
export RAY_worker_niceness=0
export RAY_USAGE_STATS_ENABLED=0
