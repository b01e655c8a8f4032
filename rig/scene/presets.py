"""Films that laboratories use, as a first belief: what `dea-rig init` writes into a scene until a fit tells better.

Each number has its source. Where only a data sheet's hardness or modulus is known, the law is neo-Hooke with the shear
modulus that follows from it; the fit that comes first will say what the film is.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Preset:
    """A film as bought or cast.

    Parameters
    ----------
    title : what it is
    thicknesses_um : as sold, before pre-stretch; the first is taken when none is asked for
    prestretch : usual equibiaxial pre-stretch of an actuator
    law, parameters : law of the film and its keys in a scene
    eps_r, breakdown_V_per_um, max_stretch : as keys of a scene; the strength is a low one of those published
    source : where the numbers come from
    """

    title: str
    thicknesses_um: tuple[float, ...]
    prestretch: float
    law: str
    parameters: dict[str, float | list[float]]
    eps_r: float
    breakdown_V_per_um: float
    max_stretch: float
    source: str


_FOO = (
    "Relaxed network of C. C. Foo, S. Cai, S. J. A. Koh, S. Bauer, Z. Suo, Model of dissipative dielectric elastomers, "
    "J. Appl. Phys. 111 (2012) 034102: mu 18 kPa, Jm 110, permittivity 3.98e-11 F/m. Fast loading is three times "
    "stiffer. Strength: low end of what is published for pre-stretched VHB"
)
_WACKER = (
    "Wacker, data sheet of ELASTOSIL Film 2030: 27 Shore A, permittivity 2.8, strength 80 V/um, elongation 450 %; "
    "modulus from the hardness by A. N. Gent, Rubber Chem. Technol. 31 (1958) 896"
)

PRESETS = {
    "parker": Preset(
        title="Parker silicone film of Cao & Conn",
        thicknesses_um=(40.0,),
        prestretch=1.2,
        law="ogden",
        parameters={"mu_Pa": [5e3, 35e3], "alpha": [2.5, 5.6]},
        eps_r=1.7,
        breakdown_V_per_um=80.0,
        max_stretch=2.4,
        source="C. Cao, A. T. Conn, Performance Optimization of a Conical Dielectric Elastomer Actuator, Actuators 7 "
        "(2018) 32; strength and elongation are the manufacturer's",
    ),
    "vhb-4905": Preset(
        "3M VHB 4905, acrylic", (500.0,), 3.0, "gent", {"mu_Pa": 18e3, "Jm": 110.0}, 4.5, 100.0, 7.0, _FOO
    ),
    "vhb-4910": Preset(
        "3M VHB 4910, acrylic", (1000.0,), 3.0, "gent", {"mu_Pa": 18e3, "Jm": 110.0}, 4.5, 100.0, 7.0, _FOO
    ),
    "elastosil-2030": Preset(
        title="Wacker ELASTOSIL Film 2030, silicone",
        thicknesses_um=(100.0, 20.0, 50.0, 200.0, 250.0, 400.0),
        prestretch=1.2,
        law="neo_hooke",
        parameters={"mu_Pa": 336e3},
        eps_r=2.8,
        breakdown_V_per_um=80.0,
        max_stretch=4.0,
        source=_WACKER,
    ),
    "ecoflex-00-30": Preset(
        title="Smooth-On Ecoflex 00-30, cast silicone",
        thicknesses_um=(200.0,),
        prestretch=1.5,
        law="neo_hooke",
        parameters={"mu_Pa": 39e3},
        eps_r=2.8,
        breakdown_V_per_um=14.0,
        max_stretch=6.0,
        source="Smooth-On, technical bulletin Ecoflex: 100 % modulus 69 kPa, strength above 350 V/mil. Permittivity: "
        "usual value of unfilled silicone, not from the bulletin; let the fit tell it",
    ),
    "sylgard-184": Preset(
        title="Dow Sylgard 184, cast silicone",
        thicknesses_um=(100.0,),
        prestretch=1.1,
        law="neo_hooke",
        parameters={"mu_Pa": 440e3},
        eps_r=2.7,
        breakdown_V_per_um=19.0,
        max_stretch=2.0,
        source="I. D. Johnston et al., Mechanical characterization of bulk Sylgard 184, J. Micromech. Microeng. 24 "
        "(2014) 035017: Young's modulus 1.32 MPa when cured at 25 C; Dow, data sheet: permittivity 2.7, 19 V/um",
    ),
}
