#!/usr/bin/env bash
# Slurm on this machine alone: a cluster of one node with all its cores, to try `robocas plan run --executor slurm`.
#
#     scripts/slurm_here.sh           installs (Debian, Ubuntu) and starts munge, slurmctld and slurmd; needs root
#     scripts/slurm_here.sh status    says what runs; ends with 0 if Slurm answers
#     scripts/slurm_here.sh stop      cancels all jobs and ends what was started
#
# Jobs go to the partition `here`; those of a second one, `first`, preempt them: they are sent back to the queue.
#
# Needs no systemd, so it works in a container. Started twice, it is started once. A slurm.conf that is none of its own
# stays as it is, and then nothing is started. What the daemons say is in /var/log/robocas-slurm, what they remember in
# /var/lib/robocas-slurm. Memory is not shared out: jobs may ask for what they like.
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

# Process id in a file of a daemon, if that still runs and is no other's by now.
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
    command -v apt-get >/dev/null || refuse "install slurmctld, slurmd, sbatch and munge; there is no apt-get here"
    say "installing slurmctld, slurmd, slurm-client and munge"
    local log
    log=$(mktemp)
    if ! { apt-get update -qq && apt-get install -y -qq --no-install-recommends \
        slurmctld slurmd slurm-client munge; } >"$log" 2>&1; then
        tail -n 5 "$log" >&2
        refuse "could not install them; all of apt's words are in $log"
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
# a requeued job waits until its credentials are over, two minutes by default
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
# jobs of \`first\` send those of \`here\` back to the queue
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
        say "runs already"
        return
    fi
    [ "$(id -u)" = 0 ] || refuse "run this as root"
    if [ -e "$conf" ] && ! ours; then refuse "$conf is somebody's: start that Slurm, or move the file away"; fi
    install_packages
    mkdir -p "$logs" "$state/ctld" "$state/d"
    write_conf
    start_munge
    running /run/robocas-slurmctld.pid slurmctld >/dev/null || slurmctld
    wait_until answers || refuse "slurmctld does not answer; see $logs/slurmctld.log"
    running /run/robocas-slurmd.pid slurmd >/dev/null || slurmd
    wait_until node_is_up || refuse "the node is $(sinfo --noheader --partition=here --format=%T); see $logs/slurmd.log"
    say "a cluster of $(sinfo --noheader --partition=here --format=%c) cores is up; scripts/slurm_here.sh stop ends it"
}

stop() {
    if ! ours; then
        say "no Slurm of this script is here"
        return
    fi
    [ "$(id -u)" = 0 ] || refuse "run this as root"
    if answers; then
        squeue --noheader --format=%A | sort -u | xargs -r scancel || true
        # shellcheck disable=SC2016
        wait_until eval '[ -z "$(squeue --noheader)" ]' || say "some jobs don't end; they are left to themselves"
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
    answers || refuse "does not answer"
    sinfo
    squeue
}

case ${1:-start} in
    start) start ;;
    stop) stop ;;
    status) status ;;
    *) refuse "start, status or stop; the head of this script says more" ;;
esac
