"""Small mechanisms as MJCF, of the kinds that other people's hands are made of."""

from __future__ import annotations

from collections.abc import Callable

_HEAD = '<mujoco model="{name}"><compiler angle="radian"/><option gravity="0 0 0"/>'
_PALM = '<geom type="box" size=".02 .02 .01"/>'


def _link(name: str, at: float, inside: str = "", joint: str = "", x: float = 0.0) -> str:
    """A link that turns about y, 40 mm long, with what it carries; joint: more attributes of its joint."""
    return (
        f'<body name="{name}" pos="{x} 0 {at}"><joint name="{name}" axis="0 1 0" range="-0.2 1.6" {joint}/>'
        f'<site name="{name}_low" pos=".009 0 .008"/><site name="{name}_high" pos=".007 0 .03"/>'
        f'<geom type="capsule" size=".005" fromto="0 0 .01 0 0 .035"/>{inside}</body>'
    )


def _finger(near: str = "", far: str = "", prefix: str = "", x: float = 0.0) -> str:
    return _link(f"{prefix}near", 0.02, _link(f"{prefix}far", 0.04, joint=far), near, x)


def _hand(name: str, bodies: str, rest: str) -> str:
    palm = f'<body name="palm">{_PALM}<site name="palm_site" pos=".01 0 .012"/>{bodies}</body>'
    return f"{_HEAD.format(name=name)}<worldbody>{palm}</worldbody>{rest}</mujoco>"


def _fixed(name: str, arms: dict[str, float], more: str = "") -> str:
    joints = "".join(f'<joint joint="{joint}" coef="{arm}"/>' for joint, arm in arms.items())
    return f'<fixed name="{name}" {more}>{joints}</fixed>'


def _routed(name: str, sites: tuple[str, ...], more: str = "") -> str:
    return f'<spatial name="{name}" {more}>' + "".join(f'<site site="{s}"/>' for s in sites) + "</spatial>"


def _pull(tendon: str, kp: float, most: float, more: str = 'forcerange="0 1e6"') -> str:
    limited = f'ctrlrange="0 {most}" {more}'
    return f'<actuator><position name="motor" tendon="{tendon}" kp="{kp}" {limited}/></actuator>'


_WAY = ("palm_site", "near_low", "near_high", "far_low", "far_high")
_ARMS = {"near": 0.01, "far": 0.008}


def _tendon_spring() -> str:
    tendons = _fixed("flexor", _ARMS) + _fixed("back", {"far": 0.01}, 'stiffness="350" springlength="0"')
    rest = f"<tendon>{tendons}</tendon>" + _pull("flexor", 1e4, 0.025)
    return _hand("tendon_spring", _finger('stiffness=".035"'), rest)


def _slack_spring() -> str:
    tendons = _fixed("flexor", _ARMS) + _fixed("back", _ARMS, 'stiffness="900" springlength="0 .006"')
    rest = f"<tendon>{tendons}</tendon>" + _pull("flexor", 1e4, 0.025)
    return _hand("slack_spring", _finger('stiffness=".02"', 'stiffness=".03"'), rest)


def _routed_flexor() -> str:
    tendon = f"<tendon>{_routed('flexor', _WAY)}</tendon>"
    motor = (
        '<actuator><position name="motor" tendon="flexor" kp="8000" ctrlrange=".05 .1" forcerange="-1e6 0"/>'
    )
    return _hand("routed", _finger('stiffness=".04"', 'stiffness=".03"'), f"{tendon}{motor}</actuator>")


def _routed_spring() -> str:
    tendons = _fixed("flexor", _ARMS) + _routed("back", _WAY, 'stiffness="300" springlength=".07"')
    rest = f"<tendon>{tendons}</tendon>" + _pull("flexor", 1e4, 0.025)
    return _hand("routed_spring", _finger('stiffness=".05"', 'stiffness=".05"'), rest)


def _stops() -> str:
    rest = f"<tendon>{_fixed('flexor', {'near': 1.0, 'far': 0.8})}</tendon>" + _pull("flexor", 40, 2.6)
    return _hand("stops", _finger('stiffness=".01"', 'stiffness=".05"'), rest)


def _preloaded() -> str:
    rest = f"<tendon>{_fixed('flexor', {'near': 1.0, 'far': 0.8})}</tendon>" + _pull("flexor", 40, 2.0)
    bodies = _finger('stiffness=".1" springref="-1"', 'stiffness=".05"')
    return _hand("preloaded", bodies, rest)


def _servos() -> str:
    motors = "".join(
        f'<position name="m_{j}" joint="{j}" kp="{kp}" ctrlrange="0 1.5"/>'
        for j, kp in (("near", 8), ("far", 3))
    )
    return _hand("servos", _finger(), f"<actuator>{motors}</actuator>")


def _coupled() -> str:
    rest = '<equality><joint joint1="far" joint2="near" polycoef="0 .7 0 0 0"/></equality>'
    rest += '<actuator><position name="motor" joint="near" kp="5" ctrlrange="0 1.5"/></actuator>'
    return _hand("coupled", _finger('stiffness=".1"', 'stiffness=".05" springref=".3"'), rest)


def _curved() -> str:
    rest = '<equality><joint joint1="far" joint2="near" polycoef=".05 .6 .3 -.1 0"/></equality>'
    rest += '<actuator><position name="motor" joint="near" kp="5" ctrlrange="0 1.5"/></actuator>'
    return _hand("curved", _finger('stiffness=".1"', 'stiffness=".05"'), rest)


def _four_bar() -> str:
    coupler = '<body name="coupler" pos="0 0 .04"><joint name="coupler" axis="0 1 0" range="-1.6 1.6"/>'
    coupler += '<geom type="capsule" size=".004" fromto="0 0 .005 0 0 .025"/></body>'
    bodies = _link("crank", 0.02, coupler, x=0.03) + _link("rocker", 0.02, joint='stiffness=".05"', x=0.015)
    rest = '<equality><connect body1="coupler" body2="rocker" anchor="0 0 .03"/></equality>'
    rest += '<actuator><position name="motor" joint="crank" kp="4" ctrlrange="0 1"/></actuator>'
    return _hand("four_bar", bodies, rest)


def _tied_tendons() -> str:
    tendons = _fixed("one", _ARMS) + _fixed("other", {"b_near": 0.01, "b_far": 0.006})
    rest = f"<tendon>{tendons}</tendon>"
    rest += '<equality><tendon tendon1="one" tendon2="other" polycoef="0 1 0 0 0"/></equality>'
    fingers = _finger('stiffness=".05"', 'stiffness=".04"')
    fingers += _finger('stiffness=".03"', 'stiffness=".06"', "b_", 0.03)
    return _hand("tied", fingers, rest + _pull("one", 6000, 0.02, ""))


def _two_motors() -> str:
    tendons = (
        _fixed("flexor", _ARMS) + _routed("extensor", _WAY) + _fixed("stay", {"far": 0.01}, 'stiffness="200"')
    )
    motors = '<position name="flex" tendon="flexor" kp="9000" ctrlrange="0 .02" forcerange="0 1e6"/>'
    motors += '<position name="hold" tendon="extensor" kp="4000" ctrlrange=".05 .1" forcerange="-1e6 0"/>'
    rest = f"<tendon>{tendons}</tendon><actuator>{motors}</actuator>"
    return _hand("two_motors", _finger('stiffness=".04"', 'stiffness=".02"'), rest)


_MADE: tuple[Callable[[], str], ...] = (
    _tendon_spring, _slack_spring, _routed_flexor, _routed_spring, _stops, _preloaded,
    _servos, _coupled, _curved, _four_bar, _tied_tendons, _two_motors,
)  # fmt: skip

MECHANISMS = {make.__name__[1:]: make() for make in _MADE}
"""Name -> MJCF, twelve of them."""
