"""Five minutes on two CPU cores: small networks on MO-HalfCheetah, beside policies that have learned nothing."""

import time

import mujoco
import torch as th

from sb3_momba import evaluate_front, make_mo_vec_env
from sb3_momba.pareto.floors import RandomPolicy, ZeroActionPolicy
from sb3_momba.train import RunSettings, report, run

# Networks this small are faster on one thread than on two.
th.set_num_threads(1)

# MuJoCo 4 complains of a deprecated word in Gymnasium's model, once for every copy of the environment.
mujoco.set_mju_user_warning(lambda message: None)

ENV = "mo-halfcheetah-v5"
REFERENCE_POINT = [-100.0, -2_500.0]
EVALUATION = {"n_preferences": 20, "n_episodes": 1}

action_space = make_mo_vec_env(ENV).action_space
floors = {
    "standing still": evaluate_front(ZeroActionPolicy(action_space), ENV, **EVALUATION),
    "random actions": evaluate_front(RandomPolicy(action_space), ENV, **EVALUATION),
}
started = time.monotonic()
result = run(
    RunSettings(
        env=ENV,
        output=f"runs/demo/{time.strftime('%Y%m%d-%H%M%S')}",
        steps=25_000,
        eval_freq=5_000,
        reference_point=REFERENCE_POINT,
        objectives=["distance run", "energy spent (negative)"],
        hyperparameters={
            "ent_coef": "auto_0.01",
            "learning_rate": 3e-4,
            "learning_starts": 1_000,
            "batch_size": 128,
            "policy_kwargs": {"actor_hidden_dim": 64, "actor_blocks": 1, "critic_hidden_dim": 64, "critic_blocks": 1},
        },
        **EVALUATION,
    )
)
print(f"\n{ENV}, {time.monotonic() - started:.0f} s")
for name, front in floors.items():
    print(f"{name:>17}  {front.hypervolume(REFERENCE_POINT):>17,.6g}")
print(report(result))
floor = max(front.hypervolume(REFERENCE_POINT) for front in floors.values())
print(f"Hypervolume {result.front.hypervolume(REFERENCE_POINT) / floor:.1f} times that of the better of them.")
