#!/usr/bin/env python3
"""A Slurm of two nodes on this machine, one of which is killed: ingest, extract and generate over the demo's songs.

    make cluster-demo                                  builds first
    pipelines/slurm/demo.py --bin target/debug         with executables that are there already
    … --songs 8 --shards 4                             with some of the songs
    … --source FOLDER --cost                           with songs of your own; what each way took

Starts munged, slurmctld and two slurmd on loopback, with a configuration, keys and folders of their own. The chain of
submit.sh runs on them; while a task of generate is at work on node c2, that node is killed whole. Slurm queues its tasks again,
node c1 takes them over, and the tables have to be those of the same stages run on one machine, to the last bit.

Whatever happens, everything that was started is ended, by its process number. Exit code 0: the tables are equal; 1: they
are not, or something went another way than it should; 2: it could not run.
"""

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
SONGS = ROOT / "tests/data/music"
AUDIO = {".flac", ".mp3", ".ogg", ".wav"}
PACKAGES = {"slurmctld": "slurmctld", "slurmd": "slurmd", "sbatch": "slurm-client", "munged": "munge"}
STAGES = ["ingest", "extract", "generate"]
NODES = ["c1", "c2"]
KILLED = "c2"
# The stage that is under way then: its tasks are the longest, and hold a lease each.
KILLED_DURING = "generate"
# What the stages write; columns of clock times and places are left out by diff-tables.
TABLES = "phrases,beats,features,extractions,generated,decoded,generations,failures"
# Longest wait for what must happen, in seconds, and the pause between two looks.
PATIENCE_S = 240
PAUSE_S = 0.1

CONFIGURATION = """\
ClusterName=demo
SlurmctldHost={host}(127.0.0.1)
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/munge
AuthInfo=socket={run}/munge.sock
CryptoType=crypto/munge
SlurmUser={user}
SlurmdUser={user}
SlurmctldPort={ports[0]}
StateSaveLocation={run}/state
SlurmdSpoolDir={run}/spool.%n
SlurmctldPidFile={run}/slurmctld.pid
SlurmdPidFile={run}/slurmd.%n.pid
SlurmctldLogFile={log}/slurmctld.log
SlurmdLogFile={log}/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerType=sched/backfill
SchedulerParameters=batch_sched_delay=0
MpiDefault=none
ReturnToService=2
SlurmdTimeout=10
SlurmctldTimeout=10
InactiveLimit=0
KillWait=5
MinJobAge=3600
RequeueExit=75
JobRequeue=1
DisableRootJobs=NO
NodeName=c1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=2000
NodeName=c2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 RealMemory=2000
PartitionName=main Nodes=c1,c2 Default=YES MaxTime=INFINITE State=UP
"""


class CannotRun(Exception):
    """What keeps the demo from running at all."""


class WentWrong(Exception):
    """What went another way than it should."""


def say(text):
    print(f"{time.monotonic() - STARTED:6.1f} s  {text}", flush=True)


def run(words, **more):
    """Runs a command to its end and returns what it printed."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, **more)
    if done.returncode != 0:
        told = (done.stdout + done.stderr).strip()
        raise WentWrong(f"{' '.join(map(str, words))}: exit code {done.returncode}: {told}")
    return done.stdout


def wait_until(what, is_so, patience_s=PATIENCE_S):
    """Waits until something is so, and returns it."""
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        found = is_so()
        if found:
            return found
        time.sleep(PAUSE_S)
    raise WentWrong(f"waited {patience_s} s in vain for {what}")


def install_what_is_missing():
    """Installs Slurm and munge, where there is apt-get and the right to use it."""
    os.environ["PATH"] += ":/usr/sbin:/sbin"
    missing = sorted({package for tool, package in PACKAGES.items() if not shutil.which(tool)})
    if not missing:
        return
    if not shutil.which("apt-get"):
        raise CannotRun(f"{', '.join(missing)} are missing, and there is no apt-get to install them with")
    say(f"installing {', '.join(missing)}")
    sudo = [] if os.geteuid() == 0 else ["sudo", "-n"]
    apt = [*sudo, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq", "-o", "DPkg::Lock::Timeout=300"]
    try:
        run([*apt, "update"])
        run([*apt, "install", "--no-install-recommends", *missing])
    except WentWrong as error:
        raise CannotRun(f"Slurm could not be installed: {error}") from error


def free_ports(n):
    """Returns ports that nobody listens on just now."""
    sockets = [socket.socket() for _ in range(n)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"


class Cluster:
    """A Slurm of two nodes on loopback."""

    def __init__(self, logs):
        self.folder = Path(tempfile.mkdtemp(prefix="motiongen-slurm-"))
        self.folder.chmod(0o755)
        self.conf = self.folder / "slurm.conf"
        (self.folder / "state").mkdir()
        for node in NODES:
            (self.folder / f"spool.{node}").mkdir()
        self.logs = logs

    def pid(self, daemon):
        try:
            return int((self.folder / f"{daemon}.pid").read_text())
        except (FileNotFoundError, ValueError):
            return None

    def start(self):
        folder = self.folder
        host, user = socket.gethostname().split(".")[0], run(["id", "-un"]).strip()
        self.conf.write_text(
            CONFIGURATION.format(host=host, user=user, run=folder, log=self.logs, ports=free_ports(3))
        )
        # Exported to everything, so that no /etc/slurm is read.
        os.environ["SLURM_CONF"] = str(self.conf)
        key = folder / "munge.key"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o400)
        run(
            ["munged", f"--key-file={key}", f"--socket={folder}/munge.sock", f"--pid-file={folder}/munged.pid"]
            + [f"--log-file={self.logs}/munged.log", f"--seed-file={folder}/munged.seed", "--force"]
        )
        run(["slurmctld", "-c", "-f", self.conf], stdin=subprocess.DEVNULL)
        for node in NODES:
            run(["slurmd", "-N", node, "-f", self.conf], stdin=subprocess.DEVNULL)

        def idle():
            told = subprocess.run(["sinfo", "-h", "-t", "idle", "-o", "%D"], capture_output=True, text=True)
            return told.stdout.strip() == str(len(NODES))

        wait_until("two idle nodes", idle)

    def processes(self, node=None):
        """Returns the processes of jobs of this cluster, of one node, and the slurmstepd above them."""
        found = set()
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit() or int(entry.name) == os.getpid():
                continue
            try:
                environment = (entry / "environ").read_bytes().split(b"\0")
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                is_step = (Path(f"/proc/{parent}/comm").read_text()).startswith("slurmstepd")
            except (OSError, ValueError, IndexError):
                continue
            names = [one for one in environment if one.startswith(b"SLURMD_NODENAME=")]
            if f"SLURM_CONF={self.conf}".encode() not in environment or not names:
                continue
            if node is None or names[0] == f"SLURMD_NODENAME={node}".encode():
                found.add(int(entry.name))
                if is_step:
                    found.add(parent)
        return found

    def kill(self, node):
        """Kills a node whole: its slurmd, its slurmstepds, its jobs."""
        daemon = self.pid(f"slurmd.{node}")
        for pid in [daemon, *self.processes(node)]:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        wait_until(f"the end of {node}", lambda: not is_alive(daemon) and not self.processes(node))

    def stop(self):
        """Ends everything that was started."""
        for pid in self.processes():
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        daemons = [*(f"slurmd.{node}" for node in NODES), "slurmctld", "munged"]
        for daemon in daemons:
            pid = self.pid(daemon)
            if pid is None or not is_alive(pid):
                continue
            for name in [signal.SIGTERM, signal.SIGKILL]:
                try:
                    os.kill(pid, name)
                except ProcessLookupError:
                    break
                until = time.monotonic() + 10
                while is_alive(pid) and time.monotonic() < until:
                    time.sleep(PAUSE_S)
                if not is_alive(pid):
                    break
        shutil.rmtree(self.folder, ignore_errors=True)


def jobs(form, more=()):
    """Returns the fields of every task that waits or runs."""
    return [line.split("|") for line in run(["squeue", "-h", "-r", "-o", form, *more]).splitlines()]


def field(text, name):
    return next((word.split("=", 1)[1] for word in text.split() if word.startswith(f"{name}=")), "")


def submit(arguments, motiongen, songs, store, logs):
    """Submits the chain, and returns the job of every stage."""
    settings = {
        "SOURCE": songs,
        "STORE": store,
        "MODEL": "pretrained",
        "STAGES": " ".join(STAGES),
        "SHARDS": arguments.shards,
        "LOGS": logs,
        "MOTIONGEN": motiongen,
        "SBATCH": "--cpus-per-task=1 --mem=500M --time=30",
        "GENERATE": GENERATE,
    }
    environment = os.environ | {name: str(value) for name, value in settings.items()}
    told = run([HERE / "submit.sh"], env=environment)
    print("".join(f"          {line}\n" for line in told.splitlines()), end="", flush=True)
    found = {line.split()[0]: line.split()[2].rstrip(",") for line in told.splitlines() if " job " in line}
    if list(found) != STAGES:
        raise WentWrong(f"submit.sh submitted {list(found)}")
    return found


# As fast as it goes: what is compared is the same either way.
GENERATE = "--steps 4 --quiet"


def some_songs(n, folder):
    """Copies the first songs into a folder, and returns it."""
    files = sorted(path for path in SONGS.glob("*/*") if path.suffix in AUDIO)
    if n > len(files):
        raise CannotRun(f"--songs {n} is more than the {len(files)} songs of {SONGS}")
    for path in files[:n]:
        (folder / path.parent.name).mkdir(parents=True, exist_ok=True)
        # With the beats that lie beside some.
        for one in [path, path.with_suffix(".beats.txt")]:
            if one.exists():
                shutil.copy(one, folder / path.parent.name)
    return folder


def one_machine(motiongen, songs, store):
    flags = {"ingest": ["--source", songs], "generate": ["--model", "pretrained", *GENERATE.split()]}
    for stage in STAGES:
        run([motiongen, stage, "--store", store, *flags.get(stage, [])])


# Calls an executable and adds a line to a file: seconds by the clock, of the user and of the system.
METER = """\
#!/bin/bash
TIMEFORMAT='%R %U %S'
exec 3>&1 4>&2
took=$({{ time {motiongen} "$@" >&3 2>&4; }} 2>&1)
code=$?
echo "$took" >> {costs}
exit $code
"""


class Costs:
    """The processor seconds of processes that end by themselves; those of killed ones are not known."""

    def __init__(self, motiongen, folder, name):
        self.place = folder / f"{name}.costs"
        self.program = folder / f"{name}.sh"
        self.program.write_text(METER.format(motiongen=motiongen, costs=self.place))
        self.program.chmod(0o755)
        self.started = time.monotonic()

    def said(self):
        took_s = time.monotonic() - self.started
        rows = [[float(word) for word in line.split()] for line in self.place.read_text().splitlines()]
        cpu_s = sum(user + system for _, user, system in rows)
        return f"{took_s:.1f} s, {cpu_s:.1f} s of processors in {len(rows)} processes"


def two_nodes(cluster, arguments, motiongen, songs, store, logs):
    """Runs the chain on the cluster, kills a node on the way, and returns how many tasks were taken over."""
    chain = submit(arguments, motiongen, songs, store, logs)
    job = chain[KILLED_DURING]

    def under_way():
        on_it = [task for task, node, state in jobs("%i|%N|%t", ["-j", job]) if node == KILLED and state == "R"]
        if not jobs("%i", ["-j", job]):
            raise WentWrong(f"{KILLED_DURING} ended before a task of it was seen on {KILLED}, which is to be killed")
        names = [Path(f"/proc/{pid}/comm") for pid in cluster.processes(KILLED)]
        is_at_work = any(path.exists() and path.read_text().startswith("motiongen") for path in names)
        return on_it if is_at_work else None

    lost = wait_until(f"a task of {KILLED_DURING} on {KILLED}", under_way, arguments.patience_s)
    cluster.kill(KILLED)
    say(f"node {KILLED} killed, with its slurmd and the tasks {', '.join(lost)} of {KILLED_DURING}")
    is_down = lambda: run(["sinfo", "-h", "-n", KILLED, "-o", "%T"]).strip().startswith("down")
    wait_until(f"{KILLED} to be down", is_down)
    say(f"Slurm has found out: {KILLED} is down")

    def is_over():
        waiting = jobs("%i|%t|%r")
        for task, state, reason in waiting:
            # Slurm waits two minutes before it starts again what was queued again.
            if state == "PD" and reason == "BeginTime":
                subprocess.run(["scontrol", "update", f"jobid={task}", "StartTime=now"], capture_output=True)
        return not waiting

    wait_until("the end of the chain", is_over, arguments.patience_s)
    n_taken_over = 0
    for stage, job in chain.items():
        tasks = [told for told in run(["scontrol", "-o", "show", "job", job]).splitlines() if told.strip()]
        if len(tasks) != arguments.shards:
            raise WentWrong(f"{stage} has {len(tasks)} tasks, not {arguments.shards}")
        for told in tasks:
            name = f"{stage} {field(told, 'ArrayTaskId')}"
            if field(told, "JobState") != "COMPLETED":
                raise WentWrong(f"{name} ended as {field(told, 'JobState')}, exit code {field(told, 'ExitCode')}")
            if field(told, "Restarts") != "0":
                n_taken_over += 1
                say(f"{name}: started {int(field(told, 'Restarts')) + 1} times, done on {field(told, 'BatchHost')}")
                if field(told, "BatchHost") == KILLED:
                    raise WentWrong(f"{name} was done on the node that was killed")
    if n_taken_over == 0:
        raise WentWrong("no task was started again, so nothing was taken over")
    return n_taken_over


def compare(diff_tables, motiongen, one, two):
    """Raises what differs between the tables of two stores."""
    words = [diff_tables, "--tables", TABLES, "--tolerance", "0", one, two]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True)
    if done.returncode != 0:
        told = (done.stdout + done.stderr).strip()
        raise WentWrong(f"the tables of the cluster are not those of one machine:\n{told}")
    done = subprocess.run([str(motiongen), "status", "--store", str(two)], capture_output=True, text=True)
    if done.returncode != 0:
        raise WentWrong(f"motiongen status: exit code {done.returncode}: {done.stdout}{done.stderr}")
    print(done.stdout, end="", flush=True)


def demo(arguments):
    motiongen, diff_tables = arguments.bin / "motiongen", arguments.bin / "examples/diff-tables"
    for program in [motiongen, diff_tables]:
        if not os.access(program, os.X_OK):
            raise CannotRun(f"{program} is missing; build it with: cargo build --bins --example diff-tables")
    install_what_is_missing()
    out = arguments.out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    logs = out / "logs"
    logs.mkdir(parents=True)
    for name in [name for name in os.environ if name.startswith(("SLURM_", "SBATCH_", "MOTIONGEN_"))]:
        del os.environ[name]
    one, two = out / "one", out / "two"
    songs = arguments.source or SONGS
    if arguments.songs:
        songs = some_songs(arguments.songs, out / "songs")
    costs = Costs(motiongen, out, "one") if arguments.cost else None
    one_machine(costs.program if costs else motiongen, songs, one)
    say("one machine: ingest, extract and generate are done" + (f" in {costs.said()}" if costs else ""))
    cluster = Cluster(logs)
    try:
        cluster.start()
        say("two nodes are idle")
        costs = Costs(motiongen, out, "two") if arguments.cost else None
        program = costs.program if costs else motiongen
        n_taken_over = two_nodes(cluster, arguments, program, songs, two, logs)
        say("the chain is done" + (f" in {costs.said()}" if costs else ""))
    finally:
        cluster.stop()
    compare(diff_tables, motiongen, one, two)
    say(
        f"cluster-demo: {n_taken_over} tasks of a killed node were taken over, and the tables equal those of one machine"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=Path, default=Path("target/debug"), help="folder of the executables")
    parser.add_argument("--out", type=Path, default=Path("build/cluster-demo"), help="folder of stores and logs")
    parser.add_argument("--shards", type=int, default=8, help="tasks of every stage")
    songs = parser.add_mutually_exclusive_group()
    songs.add_argument("--songs", type=int, help="as many of the songs of tests/data; all of them otherwise")
    songs.add_argument("--source", type=Path, help="a folder of other songs")
    parser.add_argument("--patience-s", type=float, default=PATIENCE_S, help="longest wait for the stages")
    parser.add_argument("--cost", action="store_true", help="say how long either way took, and of how many processors")
    arguments = parser.parse_args()
    arguments.bin = arguments.bin.resolve()
    arguments.source = arguments.source and arguments.source.resolve()
    # A signal ends the demo as an error does, so that the cluster is stopped.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
    try:
        demo(arguments)
    except CannotRun as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except WentWrong as error:
        print(f"cluster-demo FAILED: {error}\nlogs: {arguments.out}/logs", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 75
    return 0


STARTED = time.monotonic()
if __name__ == "__main__":
    sys.exit(main())
