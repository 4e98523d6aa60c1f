#!/usr/bin/env bash
# Start a Slurm cluster of one node, this machine with all its cores, to test `robocas plan run --executor slurm`.
#
#     scripts/slurm_here.sh           install (Debian, Ubuntu) and start munge, slurmctld and slurmd; needs root
#     scripts/slurm_here.sh status    print nodes and jobs; exit status 0 if Slurm answers
#     scripts/slurm_here.sh stop      cancel all jobs and stop the daemons
#
# Jobs go to the partition `here`. Jobs of a second partition, `first`, preempt them: they return to the queue.
#
# The script needs no systemd and works in a container. A second start changes nothing. If there is a slurm.conf of another
# origin, the script keeps it and starts nothing. Logs are in /var/log/robocas-slurm, the state is in
# /var/lib/robocas-slurm. Slurm does not manage memory here: a job may request any amount.
set -euo pipefail

conf=/etc/slurm/slurm.conf
mark="# Written by scripts/slurm_here.sh"
logs=/var/log/robocas-slurm
state=/var/lib/robocas-slurm
export DEBIAN_FRONTEND=noninteractive

say() { printf 'slurm: %s\n' "$*"; }
refuse() {
    say "$*" >&2
    exit 1
}
answers() { timeout 5 sinfo --noheader >/dev/null 2>&1; }
node_is_up() { sinfo --noheader --format=%T | grep -qE "^(idle|mixed|allocated|completing)"; }
ours() { [ -f "$conf" ] && head -n 1 "$conf" | grep -qxF "$mark"; }

# Print the process id in the pid file of a daemon, if a process of its name has this id.
running() {
    local pid
    pid=$(cat "$1" 2>/dev/null) && [ -n "$pid" ] && [ "$(cat "/proc/$pid/comm" 2>/dev/null)" = "$2" ] && echo "$pid"
}

wait_until() {
    for _ in $(seq 100); do
        if "$@"; then return 0; fi
        sleep 0.2
    done
    return 1
}

install_packages() {
    command -v slurmctld >/dev/null && command -v slurmd >/dev/null && command -v sbatch >/dev/null \
        && command -v munged >/dev/null && return
    command -v apt-get >/dev/null || refuse "no apt-get on this machine. Install slurmctld, slurmd, sbatch and munge."
    say "installing slurmctld, slurmd, slurm-client and munge"
    local log
    log=$(mktemp)
    if ! { apt-get update -qq && apt-get install -y -qq --no-install-recommends \
        slurmctld slurmd slurm-client munge; } >"$log" 2>&1; then
        tail -n 5 "$log" >&2
        refuse "slurmctld, slurmd, slurm-client and munge could not be installed; the output of apt is in $log"
    fi
    rm -f "$log"
}

write_conf() {
    local host node
    host=$(hostname -s)
    node=$(slurmd -C | head -n 1)
    mkdir -p "$(dirname "$conf")"
    cat >"$conf" <<END
$mark
ClusterName=here
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
# a requeued job waits until its credentials expire, two minutes by default
AuthInfo=cred_expire=15
CredType=cred/munge
StateSaveLocation=$state/ctld
SlurmdSpoolDir=$state/d
SlurmctldPidFile=/run/robocas-slurmctld.pid
SlurmdPidFile=/run/robocas-slurmd.pid
SlurmctldLogFile=$logs/slurmctld.log
SlurmdLogFile=$logs/slurmd.log
# without cgroups and without systemd
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
SlurmctldTimeout=30
SlurmdTimeout=30
JobRequeue=1
# jobs of \`first\` return jobs of \`here\` to the queue
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
$node NodeAddr=127.0.0.1 State=UNKNOWN
PartitionName=here Nodes=ALL Default=YES MaxTime=INFINITE State=UP PriorityTier=1 PreemptMode=REQUEUE
PartitionName=first Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
END
}

start_munge() {
    if munge -n </dev/null >/dev/null 2>&1; then return; fi
    if [ ! -s /etc/munge/munge.key ]; then
        head -c 1024 /dev/urandom >/etc/munge/munge.key
        chown munge:munge /etc/munge/munge.key
        chmod 400 /etc/munge/munge.key
    fi
    install -d -o munge -g munge -m 755 /run/munge
    runuser -u munge -- /usr/sbin/munged --pid-file=/run/munge/munged.pid
    touch "$state/munged-is-ours"
    wait_until eval 'munge -n </dev/null >/dev/null 2>&1' || refuse "munged does not answer; see /var/log/munge"
}

start() {
    if answers && { ! ours || { node_is_up && running /run/robocas-slurmd.pid slurmd >/dev/null; }; }; then
        say "already running"
        return
    fi
    [ "$(id -u)" = 0 ] || refuse "run this as root"
    if [ -e "$conf" ] && ! ours; then refuse "$conf was not written by this script. Start that Slurm, or move the file."; fi
    install_packages
    mkdir -p "$logs" "$state/ctld" "$state/d"
    write_conf
    start_munge
    running /run/robocas-slurmctld.pid slurmctld >/dev/null || slurmctld
    wait_until answers || refuse "slurmctld does not answer; see $logs/slurmctld.log"
    running /run/robocas-slurmd.pid slurmd >/dev/null || slurmd
    wait_until node_is_up || refuse "the node is $(sinfo --noheader --partition=here --format=%T); see $logs/slurmd.log"
    say "a cluster of $(sinfo --noheader --partition=here --format=%c) cores is running; stop it with scripts/slurm_here.sh stop"
}

stop() {
    if ! ours; then
        say "no Slurm that this script started is running"
        return
    fi
    [ "$(id -u)" = 0 ] || refuse "run this as root"
    if answers; then
        squeue --noheader --format=%A | sort -u | xargs -r scancel || true
        # shellcheck disable=SC2016
        wait_until eval '[ -z "$(squeue --noheader)" ]' || say "some jobs do not end; they continue to run"
    fi
    end /run/robocas-slurmd.pid slurmd
    end /run/robocas-slurmctld.pid slurmctld
    if [ -e "$state/munged-is-ours" ]; then
        end /run/munge/munged.pid munged
        rm -f "$state/munged-is-ours"
    fi
    rm -f "$conf"
    say "stopped"
}

end() {
    local pid
    pid=$(running "$1" "$2") || return 0
    kill "$pid"
    wait_until eval "! kill -0 $pid 2>/dev/null" || refuse "$2 (process $pid) does not end"
}

status() {
    answers || refuse "Slurm does not answer"
    sinfo
    squeue
}

case ${1:-start} in
    start) start ;;
    stop) stop ;;
    status) status ;;
    *) refuse "unknown command '$1': expected start, status or stop" ;;
esac
