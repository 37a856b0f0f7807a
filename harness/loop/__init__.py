"""The loop of tests: where each begins, what the others do, what the AV sees and does, who runs into whom.

- `cells`: what is remembered of a running test, what is prescribed of it, and its result;
- `repeat`: the others repeat a script of motion; a family may let them do something else in the loop;
- `drive`: what the AV sees and follows;
- `judge`: how a test ends, and what stays of it;
- `loop`: a range of tests in a world, step by step.

They exchange arrays alone, all in one `cells.KernelState`; each function is called once a step for all K cells. What
an event is they do not know: a script says in which step it is, and from when on it can be seen.
"""
