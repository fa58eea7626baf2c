"""How a training chooses K and the tolerance."""

from prdp_torch.controller import LinearSchedule, PRDPController, ToleranceController


class Refinement:
    """How a training chooses K and the tolerance. Use one of the class methods below.

    Args:
        label: name of the folder of the records.
        attach: a function that takes the steppers and returns their controller.
        direct: whether the exact solver replaces that of the scene.
        watches_error: whether the controller's `step` takes the relative error instead of the metric.
    """

    def __init__(self, label, attach, direct=False, watches_error=False):
        self.label = label
        self.attach = attach
        self.direct = direct
        self.watches_error = watches_error

    @classmethod
    def auto(cls):
        """A tolerance that follows the error (`ToleranceController`), and starts from the state: nothing to choose."""

        def attach(steppers):
            for stepper in steppers:
                stepper.start = "state"
            return ToleranceController(steppers)

        return cls("auto", attach, watches_error=True)

    @classmethod
    def prdp(cls, scene, growth=None):
        """PRDP with the settings of the scene, or with another `growth` (`PRDPController`)."""
        settings = dict(scene.prdp)
        if growth is not None:
            settings["growth"] = growth
        label = "prdp" if growth is None else f"prdp_growth_{growth:g}"
        return cls(label, lambda steppers: PRDPController(steppers, **settings))

    @classmethod
    def constant(cls, k):
        """The same K throughout."""
        return cls.schedule(k, 0, k, label=f"constant_{k}")

    @classmethod
    def tolerance(cls, rtol, k):
        """The same tolerance rtol throughout, with at most k iterations."""

        def attach(steppers):
            for stepper in steppers:
                stepper.rtol = rtol
            return LinearSchedule(steppers, initial=k, increment=0, maximum=k)

        return cls(f"rtol_{rtol:g}", attach)

    @classmethod
    def schedule(cls, start, step, maximum, label=None):
        """K starts at `start` and grows by `step` after each interval, up to `maximum`."""
        return cls(
            label or f"schedule_{start}_{step}",
            lambda steppers: LinearSchedule(steppers, initial=start, increment=step, maximum=maximum),
        )

    @classmethod
    def exact(cls):
        """The exact solver."""
        return cls("direct", lambda steppers: LinearSchedule(steppers, initial=1, increment=0, maximum=1), direct=True)
