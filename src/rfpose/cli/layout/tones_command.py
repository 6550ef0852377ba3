"""``rfpose layout tones``: which tones reach a wanted accuracy."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import check_scenario, common_options, emit_json, examples, progress, say, table, wants_json

__all__ = ["command"]


@click.command(
    name="tones",
    epilog=examples(
        "rfpose layout tones site.toml --accuracy-mrad 0.5",
        "rfpose layout tones site.toml --accuracy-mrad 0.1 --band 0.5e6 12e6 --success 0.9999 --estimator shared-clock",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("--accuracy-mrad", type=float, required=True, help="Wanted rms of the mirror normal over the field.")
@click.option("--success", type=float, default=1.0 - 1e-6, help="Wanted probability of right integers, of a mirror.")
@click.option(
    "--band",
    "band_hz",
    type=(float, float),
    metavar="LOW HIGH",
    help="Tones allowed [Hz]; default: up to half the carriers' spacing.",
)
@click.option("-n", "--tones", "n_tone", type=click.IntRange(min=1), help="At most so many; the fewest that do.")
@click.option("--estimator", type=click.Choice(("independent", "rigid", "shared-clock")), default="rigid")
@click.option("--snr", "tone_snr_db", type=float, help="SNR of one tone alone [dB] instead of the scenario's.")
@click.option("--share", type=click.Choice(("index", "power", "none")), default="index", show_default=True,
              help="What several tones share: modulation index, power, or nothing.")  # fmt: skip
@common_options
def command(
    scenario: Path,
    accuracy_mrad: float,
    success: float,
    band_hz: tuple[float, float] | None,
    n_tone: int | None,
    estimator: str,
    tone_snr_db: float | None,
    share: str,
) -> None:
    """Choose the tones that reach an accuracy of the normals, with integers that are safe."""
    with progress("Searching"):
        check_scenario(scenario)
        from rfpose.pipeline.layout.toning import design_site_tones

        found = design_site_tones(
            scenario,
            accuracy_mrad=accuracy_mrad,
            success=success,
            band_hz=band_hz,
            n_tone=n_tone,
            estimator=estimator,
            tone_snr_db=tone_snr_db,
            share=share,  # type: ignore[arg-type]
        ).as_dict()
    if wants_json():
        emit_json(found)
        return
    rows = [
        [f"{k + 1}", f"{f / 1e6:.6g}", f"{w:.5g}", f"{r:.2g}"]
        for k, (f, w, r) in enumerate(zip(found["tone_hz"], found["wavelength_m"], found["step_risk"], strict=True))
    ]
    table(f"{found['scenario']}: tones", ["tone", "MHz", "wavelength [m]", "risk"], rows)
    say(f"normal, {found['estimator']}: {found['normal_mrad']:.4g} mrad rms over the field")
    risk, index = found["wrong_risk"], found["modulation_index"]
    say(f"risk of any wrong integer of a mirror: {risk:.2g}; index {index:.3g} a tone")
