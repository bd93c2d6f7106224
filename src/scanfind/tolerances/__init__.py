"""Tolerances: profiles in TOML, and what they say of a result. Nothing is searched again; nothing passes by default."""

from scanfind.design.elements import NOT_JUDGED
from scanfind.tolerances.judge import (
    IN,
    OUT,
    Check,
    Judgement,
    judge_detection,
    judge_element,
    judge_findings,
    judge_results,
    profile_in,
)
from scanfind.tolerances.profile import PRESETS, Limit, Profile, Rule, allowed_off, load_profile, profile_allowing

__all__ = [
    "IN", "NOT_JUDGED", "OUT", "PRESETS", "Check", "Judgement", "Limit", "Profile", "Rule", "allowed_off",
    "judge_detection", "judge_element", "judge_findings", "judge_results", "load_profile", "profile_allowing",
    "profile_in",
]  # fmt: skip
