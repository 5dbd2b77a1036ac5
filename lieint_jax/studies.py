"""The names of `li.studies` of version 0.2, with warnings that name their new homes."""

from lieint_jax._deprecated import renamed

_HOMES = {
    "lieint_jax": "fit observe reversible",
    "lieint_jax.adjoints": "round_trip_error",
    "lieint_jax.ensemble": "over_members",
    "lieint_jax.fitting": "Bound Fit covariance free inertia inertia_ratios interval member_by_member positive "
    "principal_inertia spd student_t student_t_curvature student_t_noise_error student_t_weights",
    "lieint_jax.app.studies": "gyro kappa material satellite sensitivity toutatis",
}

__getattr__ = renamed(__name__, {name: f"{home}:{name}" for home, names in _HOMES.items() for name in names.split()})
