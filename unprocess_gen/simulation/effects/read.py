"""Read noise of the amplifier and the converter: Gaussian, or Tukey's lambda distribution (ELD, Wei et al. 2020)."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import SiteNoise

WIDEST_STEP_DN = 0.1
"""Most DN per electron without read noise; it decides whether bright images have read noise.

Counts of electrons are integers. Without read noise, a code has ⌊1/K⌋ or ⌈1/K⌉ of them, with K in DN per electron. So
its probability differs from the mean by a share below K, and codes are missing if K is above 1 DN. Read noise of σ
electrons leaves a share of 2·exp(−2π²σ²) (Poisson's summation formula): 0.1 for σ = 0.39, and 5e-9 for σ = 1.
The heavy tails of the camera bodies (1 electron and more) leave at most 0.03.
"""


class ReadNoise(Effect):
    """Independent noise of each site, behind the gain."""

    name = "read"
    stream = declare_stream("read", 6)
    meaning = "noise of the amplifier and the converter"
    numbers = ("read_law", "read_shape", "read_std_dn")
    masks = True

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return the square of the standard deviation, DN²."""
        return frame.physics.read_std_dn * frame.physics.read_std_dn

    def reason_to_keep(self, frame: FrameFacts, on: frozenset[str]) -> str:
        """Return the step of the counts if it is above `WIDEST_STEP_DN` in any plane."""
        physics = frame.physics
        step_dn = physics.dn_per_e * (max(physics.gain_by_colour) if "gain_by_colour" in on else 1.0)
        is_kept = step_dn > WIDEST_STEP_DN and physics.read_std_dn > 0 and not on.isdisjoint(("shot", "dark_current"))
        return f"fills the codes between electrons, which are {step_dn:.3g} DN apart" if is_kept else ""

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the noise of a site."""
        physics = plan.numbers
        return {"noise": SiteNoise(self.stream, physics.read_std_dn, physics.read_law, physics.read_shape)}
