"""Small mechanisms as MJCF, of the kinds that other people's hands are made of."""

from __future__ import annotations

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


def _hand(name: str, bodies: str, tendons: str = "", actuators: str = "", equality: str = "") -> str:
    palm = f'<body name="palm">{_PALM}<site name="palm_site" pos=".01 0 .012"/>{bodies}</body>'
    rest = f"<tendon>{tendons}</tendon><equality>{equality}</equality><actuator>{actuators}</actuator>"
    return f"{_HEAD.format(name=name)}<worldbody>{palm}</worldbody>{rest}</mujoco>"


def _fixed(name: str, arms: dict[str, float], more: str = "") -> str:
    joints = "".join(f'<joint joint="{joint}" coef="{arm}"/>' for joint, arm in arms.items())
    return f'<fixed name="{name}" {more}>{joints}</fixed>'


def _routed(name: str, sites: tuple[str, ...], more: str = "") -> str:
    return f'<spatial name="{name}" {more}>' + "".join(f'<site site="{s}"/>' for s in sites) + "</spatial>"


def _pull(tendon: str, kp: float, span: str, more: str = 'forcerange="0 1e6"', name: str = "motor") -> str:
    return f'<position name="{name}" tendon="{tendon}" kp="{kp}" ctrlrange="{span}" {more}/>'


def _turn(joint: str, kp: float, most: float, name: str = "motor") -> str:
    return f'<position name="{name}" joint="{joint}" kp="{kp}" ctrlrange="0 {most}"/>'


_WAY = ("palm_site", "near_low", "near_high", "far_low", "far_high")
_ARMS, _RATIOS = {"near": 0.01, "far": 0.008}, {"near": 1.0, "far": 0.8}
_FLEXOR, _BY_RATIOS = _fixed("flexor", _ARMS), _fixed("flexor", _RATIOS)
_STIFF, _SHORTENS = _pull("flexor", 1e4, "0 0.025"), 'forcerange="-1e6 0"'
_COUPLER = (
    '<body name="coupler" pos="0 0 .04"><joint name="coupler" axis="0 1 0" range="-1.6 1.6"/>'
    '<geom type="capsule" size=".004" fromto="0 0 .005 0 0 .025"/></body>'
)
_TWO_FINGERS = _finger('stiffness=".05"', 'stiffness=".04"') + _finger(
    'stiffness=".03"', 'stiffness=".06"', "b_", 0.03
)

# bodies; tendons, actuators, equality
_MADE: dict[str, tuple[str, ...]] = {
    "tendon_spring": (
        _finger('stiffness=".035"'),
        _FLEXOR + _fixed("back", {"far": 0.01}, 'stiffness="350" springlength="0"'),
        _STIFF,
    ),
    "slack_spring": (
        _finger('stiffness=".02"', 'stiffness=".03"'),
        _FLEXOR + _fixed("back", _ARMS, 'stiffness="900" springlength="0 .006"'),
        _STIFF,
    ),
    "routed_flexor": (
        _finger('stiffness=".04"', 'stiffness=".03"'),
        _routed("flexor", _WAY),
        _pull("flexor", 8000, ".05 .1", _SHORTENS),
    ),
    "routed_spring": (
        _finger('stiffness=".05"', 'stiffness=".05"'),
        _FLEXOR + _routed("back", _WAY, 'stiffness="300" springlength=".07"'),
        _STIFF,
    ),
    "stops": (_finger('stiffness=".01"', 'stiffness=".05"'), _BY_RATIOS, _pull("flexor", 40, "0 2.6")),
    "preloaded": (
        _finger('stiffness=".1" springref="-1"', 'stiffness=".05"'),
        _BY_RATIOS,
        _pull("flexor", 40, "0 2.0"),
    ),
    "servos": (_finger(), "", _turn("near", 8, 1.5, "m_near") + _turn("far", 3, 1.5, "m_far")),
    "coupled": (
        _finger('stiffness=".1"', 'stiffness=".05" springref=".3"'), "", _turn("near", 5, 1.5),
        '<joint joint1="far" joint2="near" polycoef="0 .7 0 0 0"/>',
    ),
    "curved": (
        _finger('stiffness=".1"', 'stiffness=".05"'), "", _turn("near", 5, 1.5),
        '<joint joint1="far" joint2="near" polycoef=".05 .6 .3 -.1 0"/>',
    ),
    "four_bar": (
        _link("crank", 0.02, _COUPLER, x=0.03) + _link("rocker", 0.02, joint='stiffness=".05"', x=0.015),
        "", _turn("crank", 4, 1), '<connect body1="coupler" body2="rocker" anchor="0 0 .03"/>',
    ),
    "tied_tendons": (
        _TWO_FINGERS,
        _fixed("one", _ARMS) + _fixed("other", {"b_near": 0.01, "b_far": 0.006}),
        _pull("one", 6000, "0 0.02", ""),
        '<tendon tendon1="one" tendon2="other" polycoef="0 1 0 0 0"/>',
    ),
    "two_motors": (
        _finger('stiffness=".04"', 'stiffness=".02"'),
        _FLEXOR + _routed("extensor", _WAY) + _fixed("stay", {"far": 0.01}, 'stiffness="200"'),
        _pull("flexor", 9000, "0 .02", name="flex") + _pull("extensor", 4000, ".05 .1", _SHORTENS, "hold"),
    ),
}  # fmt: skip

MECHANISMS = {name: _hand(name, *parts) for name, parts in _MADE.items()}
"""Name -> MJCF, twelve of them."""
