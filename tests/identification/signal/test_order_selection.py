"""OrderSelection selection on a problem that has no end: what was taken in is checked all the same."""

from time import thread_time

from workbench.identification.signal.searches import OrderSelection, TimeLimit


class Endless:
    """Every candidate seems to be a mode, and takes a hundredth of a second; none is one."""

    def __init__(self):
        self.checked = 0

    def n_modes(self, model):
        return len(model)

    def strongest(self, model, rejected):
        until = thread_time() + 0.01
        while thread_time() < until:
            pass
        return complex(len(model) + 1)

    def pole_of(self, candidate):
        return candidate

    def extended(self, model, candidate):
        return (*model, candidate)

    def gain(self, smaller, larger):
        return 100.0

    def threshold(self, model, pole):
        return 10.0

    def splits(self, model, trial):
        return False

    def settled(self, model):
        return model

    def suspects(self, model):
        self.checked += 1
        for pole in model:
            yield pole, tuple(p for p in model if p != pole), True


def test_a_search_without_end_leaves_time_to_check_each_mode():
    problem, time_limit = Endless(), TimeLimit(1.0)
    found = OrderSelection(problem, 10_000, 2, 6, forgets=False, time_limit=time_limit).select(())
    assert problem.checked > 0 and len(found) <= 1, "modes that are none are gone"
    assert "search for further modes" in time_limit.unfinished


class Slow(Endless):
    """Twelve modes, each true, of which the search takes a hundredth of a second and the check nothing."""

    def strongest(self, model, rejected):
        return None if len(model) == 12 else super().strongest(model, rejected)

    def suspects(self, model):
        return ()


def test_the_search_goes_on_in_the_time_that_the_check_of_each_mode_leaves():
    time_limit = TimeLimit(0.18)  # of which the search has six tenths before the first check
    found = OrderSelection(Slow(), 10_000, 2, 6, forgets=False, time_limit=time_limit, alone=True).select(())
    assert len(found) == 12 and not time_limit.remarks


def test_what_was_ended_early_says_when():
    """A part that half of the time was for ends at half of it, not when all is spent."""
    time_limit = TimeLimit(0.1)
    part = time_limit.share(0.5)
    until = thread_time() + 0.06
    while not part.spent("search"):
        assert thread_time() < until
    (remark,) = time_limit.remarks
    seconds = float(remark.split()[2])
    assert 0.05 <= seconds < 0.09 and "of the 0.1 s allowed, unfinished: search (ended at 50 % of it);" in remark
