"""Wrong spellings and other tools' habits: the answer is a line, and the line works."""

import shlex
import signal
import subprocess
import sys
import time

import pytest

from bcrl import cli
from bcrl.config import flags, hydra_compose, jobs
from bcrl.errors import BcrlError
from bcrl.report import cli as report
from bcrl.results import verify
from bcrl.run import runner, status
from tests.conftest import plan, plans

MAZE, DQN = "env=maze", "env=linear_system algorithm=dqn"
CART = "env=gymnasium env.id=CartPole-v1"
#: The other words, the wrong word, and the words that the answer must contain.
WRONG = [
    # flags of other tools
    ("", "--env maze", "env=maze"),
    ("", "--env=maze", "env=maze"),
    ("", "-env maze", "env=maze"),
    (MAZE, "--seeds 5", "seeds=5"),
    (MAZE, "--seed 3", "seed=3"),
    (MAZE, "--workers 2", "workers=2"),
    (MAZE, "--scale paper", "scale=paper"),
    (MAZE, "--env.gamma 0.9", "env.gamma=0.9"),
    (MAZE, "--tag=x", "tag=x"),
    (MAZE, "-runs_dir x", "runs_dir=x"),
    (MAZE, "--dryrun", "--dry-run"),
    (MAZE, "--dry_run", "--dry-run"),
    (MAZE, "--mutlirun", "--multirun"),
    (MAZE, "-n", "--dry-run"),
    (MAZE, "--output out", "runs_dir=out"),
    (MAZE, "--n_jobs 2", "workers=2"),
    # words without =
    ("", "maze", "env=maze"),
    ("", "car_on_hill", "env=car_on_hill"),
    ("", "fig1", "experiment=fig1"),
    ("", "CartPole-v1", CART),
    (MAZE, "BC", "variant=BC"),
    (MAZE, "dry-run", "--dry-run"),
    (MAZE, "seeds.count:5", "seeds.count=5"),
    (MAZE, "seed 3", "seed=3"),
    (MAZE, "tag:x", "tag=x"),
    (MAZE, "tag: x", "tag=x"),
    (MAZE, "runs_dir: x", "runs_dir=x"),
    ("", "env = maze", "env=maze"),
    ("", "'env = maze'", "env=maze"),
    (MAZE, "cpu", "device=cpu"),
    # keys
    ("", "evn=maze", "env=maze"),
    ("", "ENV=maze", "env=maze"),
    ("", "environment=maze", "env=maze"),
    ("", "env_id=CartPole-v1", CART),
    (MAZE, "trees=100", "algorithm.regressor.trees=100"),
    (MAZE, "algorithm.trees=100", "algorithm.regressor.trees=100"),
    (MAZE, "n_estimators=100", "algorithm.regressor.trees=100"),
    (MAZE, "min_samples_leaf=3", "algorithm.regressor.min_samples_leaf=3"),
    (MAZE, "gamma=0.9", "env.gamma=0.9"),
    (MAZE, "env.Gamma=0.9", "env.gamma=0.9"),
    (MAZE, "iterations=5", "algorithm.iterations=5"),
    (MAZE, "lr=0.1", "algorithm=dqn algorithm.learning_rate=0.1"),
    (DQN, "lr=0.1", "algorithm.learning_rate=0.1"),
    (DQN, "learning_rate=0.1", "algorithm.learning_rate=0.1"),
    (DQN, "buffer_size=5000", "algorithm.replay_size=5000"),
    (DQN, "total_timesteps=5000", "algorithm.steps=5000"),
    (DQN, "algorithm.batchsize=16", "algorithm.batch_size=16"),
    (MAZE, "n_jobs=2", "workers=2"),
    (MAZE, "worker=2", "workers=2"),
    (MAZE, "thread=2", "threads=2"),
    (MAZE, "runs-dir=x", "runs_dir=x"),
    (MAZE, "output=x", "runs_dir=x"),
    (MAZE, "Tag=x", "tag=x"),
    (MAZE, "seeds.cuont=2", "seeds.count=2"),
    (MAZE, "transfer.nu=0.9", "transfer=policy_reuse transfer.nu=0.9"),
    (MAZE, "algorithm/regresor=tabular", "algorithm/regressor=tabular"),
    (MAZE, "algorithm.regressor=tabular", "algorithm/regressor=tabular"),
    (MAZE, "regressor=tabular", "algorithm/regressor=tabular"),
    ("-m " + MAZE, "hydra.launcher=slurm", "hydra/launcher=slurm"),
    ("-m " + MAZE, "launcher=local", "workers=2"),
    ("", "+experiment=fig1", "experiment=fig1"),
    (
        CART,
        "env.kwargs.sutton_barto_reward=true",
        "+env.kwargs.sutton_barto_reward=true",
    ),
    (CART, "~env.kwargs", "env.kwargs=null"),
    # values
    ("", "env=Maze", "env=maze"),
    ("", "env=hill", "env=car_on_hill"),
    ("", "env=car-on-hill", "env=car_on_hill"),
    ("", "env=CartPole-v1", CART),
    ("", "env=gymnasium", "env.id=CartPole-v1"),
    (MAZE, "variant=bc", "variant=BC"),
    (MAZE, "variant=BC-FQI", "variant=BC"),
    (MAZE, "variant=FQI", "variant=plain"),
    ("env=linear_system", "variant=BC-DQN", "variant=BC algorithm=dqn"),
    (MAZE, "variant=BC,C", "-m env=maze variant=BC,C"),
    (MAZE, "algorithm=DQN", "algorithm=dqn"),
    (MAZE, "algorithm=ddqn", "algorithm=dqn"),
    (MAZE, "algorithm/regressor=RandomForest", "algorithm/regressor=forest"),
    (MAZE, "curriculum=true", "curriculum=on"),
    (MAZE, "curriculum=false", "curriculum=off"),
    (MAZE, "boosting=True", "boosting=on"),
    (MAZE, "boosting=yes", "boosting=on"),
    (MAZE, "boosting=1", "boosting=on"),
    (DQN, "transfer=shape", "transfer=shaping"),
    (MAZE, "transfer=off", "transfer=none"),
    (MAZE, "scale=papers", "scale=paper"),
    (MAZE, "scale=Quick", "scale=quick"),
    ("", "experiment=figure1", "experiment=fig1"),
    ("", "experiment=1", "experiment=fig1"),
    (MAZE, "progress=off", "progress=none"),
    (MAZE, "seed=0..5", "seeds=6"),
    (MAZE, "seeds=0-9", "seeds=10"),
    (MAZE, "seeds=3-5", "seeds=[3,4,5]"),
    (MAZE, "seeds=range(5)", "seeds=5"),
    (MAZE, "seeds=range(2,5)", "seeds=[2,3,4]"),
    (MAZE, "seeds=many", "seeds=5"),
    (MAZE, "seeds=1,2,3", "seeds=[1,2,3]"),
    (MAZE, "--seeds 0 1 2", "seeds=[0,1,2]"),
    (MAZE, "tag=", "tag=null"),
    ("", "env.id=CartPole-v1", CART),
    ("", "env=gymnasium/CartPole-v1", CART),
    ("", "experiment=fig1 variant=BC", "env=car_on_hill variant=BC"),
    ("-m " + MAZE, "hydra/sweeper=optuna", "hydra/sweeper=basic"),
    ("-m " + MAZE, "env.gamma=interval(0,1)", "env.gamma=0.1,0.5"),
]
#: Answers whose line can't be composed here: it shows something, or needs a GPU.
SHOWN = [
    ("help", "--help"),
    ("version", "--version"),
    ("status", "--status"),
    ("-v", "--version"),
    (f"{MAZE} device=gpu", "device=cuda"),
    (f"{MAZE} cuda", "device=cuda"),
    (f"{MAZE} runs_dir=~/x", "runs_dir=$HOME/x"),
    (f"{MAZE} --config-name", "--config-name"),
    (f"{MAZE} hydra/launcher=slrum", "hydra/launcher=slurm"),
    ("scale=smoke", "env=maze"),
]


def asked(line: str, monkeypatch) -> str:
    """What `bcrl LINE --dry-run` shows; BcrlError as the command has it."""
    words = ["bcrl", *shlex.split(line), "--dry-run"]
    monkeypatch.setattr(sys, "argv", words)
    return status.dry_run(jobs.plans(flags.arguments()))


def answer(line: str, monkeypatch) -> str:
    """The message with which a line is rejected."""
    with pytest.raises(BcrlError) as error:
        asked(line, monkeypatch)
    return str(error.value)


def test_some_answers_name_what_to_type(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for line, right in SHOWN:
        assert right in answer(line, monkeypatch), line
    for base, wrong, right in WRONG[::4]:
        assert right in answer(f"{base} {wrong}", monkeypatch), (base, wrong)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_every_answer_is_a_line_that_works(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert len(WRONG) + len(SHOWN) >= 100
    for base, wrong, right in WRONG:
        assert right in answer(f"{base} {wrong}", monkeypatch), (base, wrong)
        kept = "env=gymnasium" if right == "env.id=CartPole-v1" else base
        if "policy_reuse" in right:
            kept = f"{DQN} curriculum=on"
        if right in ("transfer=none", "hydra/sweeper=basic") or "/launcher" in right:
            kept += " curriculum=on,off" if "-m" in kept else ""
        assert "nothing was run" in asked(f"{kept} {right}", monkeypatch), right


def test_nothing_typed_shows_what_can_be(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bcrl"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    shown = capsys.readouterr().out
    assert "bcrl env=maze" in shown and "bcrl --help" in shown
    assert len(shown.splitlines()) < 15


# --- names and seeds ---


def test_a_name_stays_what_was_typed():
    for name in ("3e563", "1e3", "2024_01_15", "007", "0x1F", "1_000", "true"):
        for typed in (name, f"'{name}'"):
            assert plan(MAZE, f"tag={typed}").name == f"FQI@{name}"
    made = plan(MAZE, "scale.name=007", "tag=t", "runs_dir=1e3")
    assert made.directory.parts[:2] == ("1e3", "007")
    swept = plans(MAZE, "tag=1e3,x", "seeds=1", multirun=True)
    assert [p.name for p in swept] == ["FQI@1e3", "FQI@x"]
    assert plan(*shlex.split(swept[0].command)[1:]).name == "FQI@1e3"
    swept = plans(MAZE, "tag=shuffle(1e3,2e3)", "seeds=1", multirun=True)
    assert {p.name for p in swept} == {"FQI@1e3", "FQI@2e3"}
    with pytest.raises(BcrlError, match=r"tag=0\.99"):
        plan(MAZE, "tag=${env.gamma}")


@pytest.mark.parametrize(
    ("typed", "seeds"),
    [
        (["seeds=5"], range(5)),
        (["seeds=[3,7,11]"], (3, 7, 11)),
        (["seed=3"], (3,)),
        (["seed=[4,2]"], (2, 4)),
        (["seeds.only=[3,7]"], (3, 7)),
        (["seeds.only=3"], (3,)),
        (["seed=${oc.env:NONE_SUCH,3}"], (3,)),
        (["seeds=${workers}", "workers=2"], (0, 1)),
        (["seeds={first: 4, count: 2}"], (4, 5)),
        (["seeds=4", "seeds.first=10"], range(10, 14)),
        (["seeds=[3,7,11]", "seeds.part=2/3"], (7,)),
        (["scale=search", "seed=1"], (1,)),
        (["seeds=[3,7]", "seeds.count=2"], (0, 1)),
    ],
)
def test_seeds_are_how_many_or_which(typed, seeds):
    made = plan(MAZE, *typed)
    assert made.seeds == tuple(seeds) and made.name == "FQI"
    assert plan(*shlex.split(made.command)[1:]).seeds == made.seeds


def test_seeds_are_swept_and_stand_in_files(tmp_path):
    swept = plans(MAZE, "seed=0,4", multirun=True)
    assert [p.seeds for p in swept] == [(0,), (4,)]
    assert runner.merged(swept)[0].seeds == (0, 4)
    for text, seeds in (
        ("seeds: 2", (0, 1)),
        ("seeds: [3, 7]", (3, 7)),
        ("seed: 5", (5,)),
    ):
        place = tmp_path / str(seeds) / "experiment"
        place.mkdir(parents=True, exist_ok=True)
        (place / "mine.yaml").write_text(f"# @package _global_\n{text}\n")
        own = {"config_dir": str(place.parent)}
        (made,) = plans(MAZE, "experiment=mine", **own)
        assert made.seeds == seeds
        (made,) = plans(MAZE, "experiment=mine", "seeds=1", **own)
        assert made.seeds == (0,)
        (made,) = plans(MAZE, "experiment=mine", "seeds=[9]", **own)
        assert made.seeds == (9,)


def test_seeds_that_are_none_are_rejected():
    wrong = (
        "~seeds",
        "seeds=[[1]]",
        "seeds=0",
        "seeds=[]",
        "seeds=[3,3]",
        "seeds=[-1]",
    )
    for typed in (*wrong, "seeds=true", "seed=1.5"):
        with pytest.raises(BcrlError, match="seed"):
            plan(MAZE, typed)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tag: '1e3,2e3'", '"1e3","2e3"'),
        ("seed: '1,2'", "seeds.only: '[1],[2]'"),
        ("boosting: glob(o*)", "boosting: 'off,on'"),
    ],
)
def test_a_sweep_in_a_file_that_hydra_reads_otherwise_is_rejected(text, said, tmp_path):
    (tmp_path / "experiment").mkdir()
    whole = "# @package _global_\nhydra: {mode: MULTIRUN, sweeper: {params: {%s}}}\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(whole % text)
    with pytest.raises(BcrlError) as error:
        plans(MAZE, "experiment=mine", config_dir=str(tmp_path))
    assert said in str(error.value)


# --- one time, one folder ---


def test_a_command_has_one_time(monkeypatch, tmp_path):
    monkeypatch.delenv(hydra_compose.STARTED, raising=False)
    (tmp_path / "local").mkdir()
    text = "# @package _global_\nruns_dir: out/${now:%H-%M-%S.%f}\n"
    (tmp_path / "local" / "default.yaml").write_text(text)
    typed = "runs_dir=out/${now:%H-%M-%S.%f}"
    for given, own in (([typed], None), ([], str(tmp_path))):
        one, other = plans(
            MAZE, "curriculum=on,off", *given, multirun=True, config_dir=own
        )
        assert one.root == other.root
    assert plan(*shlex.split(plan(MAZE, typed).command)[1:]).root == one.root


def test_globs_choose_options():
    swept = plans(MAZE, "boosting=glob(o*)", multirun=True)
    assert {p.name for p in swept} == {"FQI", "B-FQI"}
    assert len(plans("experiment=glob([fig3,fig5])", multirun=True)) == 4 + 1
    with pytest.raises(BcrlError, match=r"boosting=glob.*off, on"):
        plans(MAZE, "boosting=glob(z*)", multirun=True)


@pytest.mark.parametrize(
    "typed", ["variant=B boosting=off", "variant=plain curriculum=on"]
)
def test_a_variant_and_a_group_that_contradict_it_are_rejected(typed):
    with pytest.raises(BcrlError, match=f"variant=.*{typed.split()[1]}"):
        plan(*DQN.split(), *typed.split())
    assert plan(MAZE, "variant=BC", "boosting=on", "seeds=1").name == "BC-FQI"


# --- numbers of YAML 1.1 ---


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("env: {horizon: 5:00}", ["5:00", "300"]),
        ("seeds: {first: 010}", ["010", "8"]),
        ("seeds: {first: 0x10}", ["0x10", "16"]),
        ("seeds: [1_0]", ["1_0", "10"]),
        ("strict: yes", ["yes", "true"]),
        ("transfer: off", ["off"]),
        ("tag: 1e3", ["tag=1000.0"]),
        ("tag: 12", ["tag=12"]),
        ("evn: {gamma: 0.9}", ["evn", "env: …"]),
        ("env.gamma: 0.9", ["env: {gamma: …}"]),
        ("boosting: 'on'", ["boosting"]),
        ("variant: BC", ["defaults: [override /variant: …]"]),
        ("seed: 2\nseeds: 3", ["seed=2", "seeds"]),
        ("scale: {name: 7}", ["scale.name=7"]),
    ],
)
def test_a_number_that_yaml_reads_otherwise_is_rejected(text, said, tmp_path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(f"# @package _global_\n{text}\n")
    with pytest.raises(BcrlError) as error:
        plans(MAZE, "experiment=mine", config_dir=str(tmp_path))
    for words in said:
        assert words in str(error.value)


# --- the other commands ---


@pytest.mark.parametrize(
    ("main", "typed", "right"),
    [
        (verify.main, "--rusn-dir x", "runs_dir=x"),
        (verify.main, "-v", "--version"),
        (report.main, "HERE", "runs_dir=HERE"),
        (report.main, "runs-dir: x", "runs_dir=x"),
        (report.main, "paper", "--scale paper"),
        (report.main, "--tags x", "--tag x"),
        (report.main, "--output x", "--out x"),
        (report.main, "env=maze", "--help"),
        (report.main, "--figures 9", "4a"),
    ],
)
def test_the_other_commands_answer_too(main, typed, right, tmp_path, capsys):
    here = str(tmp_path)
    assert main(shlex.split(typed.replace("HERE", here))) == 2
    said = capsys.readouterr().err
    assert right.replace("HERE", here) in said and "Traceback" not in said


@pytest.mark.parametrize(
    "form", ["runs_dir=../{}", "--runs-dir ../{}", "--runs_dir=../{}"]
)
def test_all_three_name_the_results_alike(form, tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    words = form.format("none").split()
    assert report.main(words) == 2 and verify.main(words) == 2
    assert capsys.readouterr().err.count("../none") == 2
    if "runs_dir=../" in form and "--" in form:
        return
    monkeypatch.setattr(sys, "argv", ["bcrl", MAZE, *words])
    (made,) = jobs.plans(flags.arguments())
    assert made.root == tmp_path / "none"


@pytest.mark.parametrize("main", [verify.main, report.main])
def test_they_say_which_version(main, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0 and "bcrl 0." in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "words", "code"),
    [
        ("bcrl", ["--version"], 0),
        ("bcrl.cli", ["env=nonsense"], 2),
        ("bcrl.report.verify", ["nowhere"], 2),
    ],
)
def test_modules_run_as_the_commands_do(module, words, code, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", module, *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == code and "Traceback" not in done.stderr
    assert done.stdout + done.stderr


@pytest.mark.slow
def test_ctrl_c_at_the_start_is_silent(tmp_path):
    # A shell's background jobs, and so perhaps the tests, ignore the signal.
    program = "import signal as s; s.signal(s.SIGINT, s.default_int_handler)\n"
    program += "import sys; sys.argv[0] = 'bcrl'\n"
    program += "import bcrl; print('up', flush=True)\n"
    program += "from bcrl.cli import main; import time; time.sleep(9); main()"
    process = subprocess.Popen(
        [sys.executable, "-c", program, "env=maze"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "up\n"
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert said == "" and process.returncode == -signal.SIGINT
