#!/usr/bin/env bash
# A robot's client in the shell: a session of ten acts over HTTP with curl, in two terminals:
#
#   vlagents-ray serve noop
#   bash curl.sh http://localhost:8000 picture.jpg
#
# With https:// and a certificate authority of your own, its file is in CURL_CA_BUNDLE; a key is in VLAGENTS_RAY_API_KEY:
#
#   CURL_CA_BUNDLE=ca.pem VLAGENTS_RAY_API_KEY=vlr_... bash curl.sh https://gpu-box:8000 picture.jpg
#
# docs/protocol.md is the specification. clients/cpp/examples/loop.cpp is a loop in C++ over WebSockets, with chunks that
# are executed while the next one is computed.
set -euo pipefail
url=$1 picture=$2  # a JPEG or PNG of the camera
session=robot-$$   # no other robot has this name
key=${VLAGENTS_RAY_API_KEY:+x-api-key: $VLAGENTS_RAY_API_KEY}  # a header, read from stdin: all users see arguments

# post PATH OBS: one request; its answer is JSON, and an error's has a code that says what to do.
post() {
  local answer status
  answer=$(curl --silent --show-error --max-time 5 --write-out '\n%{http_code}' \
    --header @- --header "x-session-id: $session" --form "obs=$2" --form "cameras.front=@$picture" "$url/v1/$1" <<<"$key")
  status=${answer##*$'\n'}
  answer=${answer%$'\n'*}
  if [ "$status" != 200 ]; then
    printf 'status %s: %s\n' "$status" "$answer" >&2
    return 1
  fi
  printf '%s\n' "$answer"
}

# The metadata comes once the policy is ready.
curl --silent --show-error --fail --retry 5 --retry-connrefused --header @- "$url/v1/metadata" <<<"$key" >/dev/null
post reset '{"instruction": "push the cube to the goal", "gripper": 1.0}' >/dev/null
trap 'post close "{}" >/dev/null' EXIT

for tick in $(seq 10); do
  answer=$(post act '{"gripper": 1.0, "state": {"joints": [0, 0, 0, 0, 0, 0, 0]}}')
  [[ $answer =~ \"action\":\ *\[+([^]]*) ]]  # the action's numbers, or those of the first row of a chunk
  echo "tick $tick: ${BASH_REMATCH[1]}"     # in place of this, command the robot
done
