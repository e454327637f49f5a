# Ray over the allocation, one process a node, as `ray symmetric-run` has it, but with steps of Slurm's, so that nothing
# of another job's on these nodes is looked at or stopped; and at the first node the command, whose end ends it all.
if [ -n "$setup" ]; then source "$setup"; fi
set -uo pipefail
stopped=
trap 'stopped=1' TERM INT  # Slurm sends them to all of a job's processes: the command ends in order by itself

# Each signal ends `wait`, but not the process: Slurm may send several, and the command is still writing its results.
wait_for() {
  wait "$1"
  while kill -0 "$1" 2>/dev/null; do wait "$1"; done
  wait "$1"
}

logs=$folder/$SLURM_JOB_ID
mkdir -p -m 700 "$logs"  # the user's alone: it has the token, keys and logs
arguments=("${arguments[@]//%a/${SLURM_ARRAY_TASK_ID:-%a}}")

unset RAY_ADDRESS RAY_AUTH_TOKEN
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH=$logs/token RAY_COLOR_PREFIX=0 PATH=${python%/*}:$PATH
(umask 077 && od -An -N32 -tx1 /dev/urandom | tr -d ' \n' >"$RAY_AUTH_TOKEN_PATH")  # the user's alone
VLAGENTS_RAY_HEAD=$("$python" -m vlagents_ray_cluster.slurm.job address) || exit 1
export VLAGENTS_RAY_HEAD

srun --nodes="$SLURM_JOB_NUM_NODES" --ntasks="$SLURM_JOB_NUM_NODES" --ntasks-per-node=1 --overlap --export=ALL \
  --cpu-bind=none --kill-on-bad-exit=1 --wait=0 --open-mode=append --output="$logs/ray-%N.log" \
  "$python" -m vlagents_ray_cluster.slurm.job node &
ray=$!
"$python" -m vlagents_ray_cluster.slurm.job "${arguments[@]}" &
command=$!

wait -n "$ray" "$command"
if [ -z "$stopped" ] && ! kill -0 "$ray" 2>/dev/null && kill -TERM "$command" 2>/dev/null; then
  echo "Ray ended before the command; why is in $logs/ray-*.log" >&2
fi
wait_for "$command"
status=$?
scancel --signal=TERM "$SLURM_JOB_ID.0" 2>/dev/null  # a signal to srun would kill the step before it has cleaned up
wait_for "$ray"
rm -f "$RAY_AUTH_TOKEN_PATH"

# Out of time: the same job once more, with the same number, so that jobs that depend on it go on waiting.
if [ "$status" = "$unfinished" ] && [ "$(cat "$logs/requeued" 2>/dev/null | wc -l)" -lt "$resubmit" ]; then
  date >>"$logs/requeued"
  scontrol requeue "$SLURM_JOB_ID" && exit 0
fi
exit "$status"
