"""What people type by habit from other tools, and what it is called here."""

from __future__ import annotations

#: Habits from elsewhere: their key → ours.
KEYS = {
    "lr alpha step_size": "algorithm.learning_rate",
    "discount gamma": "env.gamma",
    "n_estimators n_trees": "algorithm.regressor.trees",
    "buffer_size memory_size replay_buffer": "algorithm.replay_size",
    "total_timesteps timesteps n_steps max_steps num_steps": "algorithm.steps",
    "n_iterations num_iterations iters": "algorithm.iterations",
    "n_episodes num_episodes": "algorithm.episodes",
    "target_update_interval target_update_freq": "algorithm.target_update",
    "eps epsilon_greedy exploration": "algorithm.epsilon",
    "net_arch hidden_sizes layers": "algorithm.hidden",
    "batch": "algorithm.batch_size",
    "max_episode_steps": "env.horizon",
    "n_jobs num_workers n_workers jobs processes": "workers",
    "n_threads num_threads": "threads",
    "n_seeds num_seeds random_state random_seed": "seeds",
    "output out output_dir outdir log_dir logdir results save_dir": "runs_dir",
    "name run_name exp_name": "tag",
    "environment task game": "env",
    "algo agent method": "algorithm",
    "exp figure fig": "experiment",
    "regressor model approximator": "algorithm/regressor",
    "launcher": "hydra/launcher",
    "checkpoint save_every": "checkpoint_every",
    "verbose log_level": "progress",
    "size budget_scale": "scale",
    "env_id gym": "env.id",
}
ALIASES = {word: ours for words, ours in KEYS.items() for word in words.split()}
#: Whole words that are none of keys and values, and what does it.
WORDS = {
    "help ? usage man": "--help",
    "version v": "--version",
    "status ls list": "--status",
    "dry_run dryrun n dry preview": "--dry-run",
    "sweep multi m": "-m",
    "cuda gpu": "device=cuda",
    "cpu": "device=cpu",
    "debug": "debug=on",
    "quiet q silent": "progress=none",
    "config config_file c": "--config-dir",
    "slurm local": "hydra/launcher={}",
    "tensorboard": "logger=tensorboard",
}
ALONE = {word: said for words, said in WORDS.items() for word in words.split()}
#: Values of keys that have few, and ours.
VALUES = {
    "device": {"gpu": "cuda", "mps": "cpu"},
    "progress": {"false": "none", "off": "none", "true": "bar", "on": "bar"},
    "variant": {"fqi": "plain", "dqn": "plain", "none": "plain", "off": "plain"},
}
YES, NO = ("true", "yes", "1", "on"), ("false", "no", "0", "off", "none", "null")
