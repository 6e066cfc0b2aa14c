"""Whose runs stand where in chapter 4: for each table and figure the titles of its cells, and the labels that records of that
cell may have. A label is the stem of the configuration that was run.

Where several labels are accepted they name one configuration, and the first that has runs on a task counts there. DPMORL's
two are the thesis's, whose policies see no returns, and the paper's.
"""

from sb3_momba.benchmark.results import FIXED_PREFERENCE

Labels = tuple[str, ...]
Methods = dict[str, Labels]

MOMBA = ("momba", "value_simba_ce_scalarised", "critic_simba_ce_256")
PGMORL = ("pgmorl",)
DPMORL = ("dpmorl_state", "dpmorl")

# Tables 4.2 and 4.3, figures 4.1 and 4.2.
MAIN: Methods = {
    "Momba": MOMBA,
    "PGMORL": PGMORL,
    "GPI-LS": ("gpi_ls",),
    "CAPQL": ("capql",),
    "DPMORL": DPMORL,
}

# Figure 4.3: curves, and methods of which the end alone is shown.
CURVES: Methods = {"Momba": MOMBA, "CAPQL": ("capql",)}
LEVELS: Methods = {"PGMORL": PGMORL, "DPMORL": DPMORL}

# Figure 4.4.
SAMPLE_EFFICIENCY: Methods = {
    "Momba UTD 1": MOMBA,
    "Momba UTD 8": ("utd_8",),
    "GPI-LS UTD 1": ("gpi_ls_utd_1",),
    "GPI-LS UTD 20": ("gpi_ls",),
}

# Figure 4.5: beside Momba, by the number of objectives the thesis's number of preferences.
FIXED = FIXED_PREFERENCE
FIXED_PREFERENCES = {2: 20, 3: 50}

# Figure 4.7: architecture and loss, then the value representation.
VALUES: dict[str, Methods] = {
    "MLP + MSE": {
        "scalarised": ("value_mlp_mse_scalarised", "critic_mlp_mse_256"),
        "vector": ("value_mlp_mse_vector",),
    },
    "MLP + CE": {
        "scalarised": ("value_mlp_ce_scalarised", "critic_mlp_ce_256"),
        "vector": ("value_mlp_ce_vector",),
    },
    "Simba + MSE": {
        "scalarised": ("value_simba_mse_scalarised", "critic_simba_mse_256"),
        "vector": ("value_simba_mse_vector",),
    },
    "Simba + CE": {
        "scalarised": MOMBA,
        "vector": ("value_simba_ce_vector",),
    },
}

# Figure 4.8: architecture and loss, then the critic's hidden dimension.
SCALING: dict[str, Methods] = {
    "MLP + MSE": {
        "256": ("critic_mlp_mse_256", "value_mlp_mse_scalarised"),
        **{width: (f"critic_mlp_mse_{width}",) for width in ("512", "1024", "2048")},
    },
    "MLP + CE": {
        "256": ("critic_mlp_ce_256", "value_mlp_ce_scalarised"),
        **{width: (f"critic_mlp_ce_{width}",) for width in ("512", "1024", "2048")},
    },
    "Simba + MSE": {
        **{width: (f"critic_simba_mse_{width}",) for width in ("64", "128")},
        "256": ("critic_simba_mse_256", "value_simba_mse_scalarised"),
        "512": ("critic_simba_mse_512",),
    },
    "Simba + CE": {
        **{width: (f"critic_simba_ce_{width}",) for width in ("64", "128")},
        "256": MOMBA,
        "512": ("critic_simba_ce_512",),
    },
}

# Figure 4.9: observation, feature and weight normalisation; a title names those that are on, joined by " + ".
NORMALISATIONS = ("FN", "ON", "WN")
NONE = "none"
NORMALISATION: Methods = {
    NONE: ("normalization_none",),
    "FN": ("normalization_fn",),
    "ON": ("normalization_on",),
    "WN": ("normalization_wn",),
    "FN + ON": ("normalization_fn_on",),
    "FN + WN": ("normalization_fn_wn",),
    "ON + WN": ("normalization_on_wn",),
    "FN + ON + WN": MOMBA,
}

# Table 4.4.
CONDITIONING: Methods = {
    "Concatenate input": MOMBA,
    "Concatenate all": ("conditioning_all",),
    "FiLM": ("conditioning_film",),
    "FiLM + concatenate all": ("conditioning_film_all",),
}

# Figure 4.10.
UTD: Methods = {"UTD 1": MOMBA, "UTD 2": ("utd_2",), "UTD 4": ("utd_4",), "UTD 8": ("utd_8",)}

# Table 4.5 and figure 4.11.
IMPROVEMENTS: Methods = {
    "Base": ("value_simba_ce_vector",),
    "HER": ("her",),
    "PAR": ("par",),
    "HER + PAR": ("her_par",),
}


def all_labels() -> set[str]:
    """Every label that some table or figure shows."""
    groups = [MAIN, CURVES, LEVELS, SAMPLE_EFFICIENCY, *VALUES.values(), *SCALING.values(), NORMALISATION]
    groups += [CONDITIONING, UTD, IMPROVEMENTS]
    return {label for methods in groups for labels in methods.values() for label in labels} | {FIXED}
