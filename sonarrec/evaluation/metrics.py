"""The figures that are told: name, how each is called on screen, and its digits."""

from __future__ import annotations

ROWS = (
    ("tpr", "TPR", 3),
    ("fpr", "FPR", 4),
    ("auc", "AUC", 3),
    ("pauc_0.05", "AUC to FPR 0.05, over 0.05", 3),
    ("tpr_at_fpr_0.01", "TPR at FPR 0.01", 3),
    ("tpr_at_fpr_0.0276", "TPR at FPR 0.0276 (paper)", 3),
    ("tpr_at_fpr_0.05", "TPR at FPR 0.05", 3),
    ("frames_to_id_median", "frames to lasting ID, median", 0),
    ("frames_to_id_90", "frames to lasting ID, 90 %", 0),
    ("false_claims_per_min", "claims/min on no landmark", 2),
    ("wrong_ids_per_min", "claims/min of a wrong ID", 2),
    ("id_switches_per_pass", "ID switches per pass", 2),
    ("track_switches_per_pass", "track switches per pass", 2),
    ("position_error_median_m", "position error, median, m", 4),
    ("position_error_95_m", "position error, 95 %, m", 4),
    ("orientation_error_median_deg", "orientation off, median, deg", 1),
    ("orientation_error_95_deg", "orientation off, 95 %, deg", 1),
    ("brier", "Brier score, 0 to 2", 3),
    ("ece", "calibration error (ECE)", 3),
)
"""Figure, how it is called on screen, and its digits."""
TESTED = ("tpr", "fpr", "auc", "tpr_at_fpr_0.0276")
DIGITS = {name: digits for name, _, digits in ROWS}
