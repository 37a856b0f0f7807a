"""The loop of tests: where each begins, what the others do, what the AV sees and does, who runs into whom.

- `cells`: the state of running tests, what is prescribed of them, and their results;
- `repeat`: the others repeat a script of motion; a family may let them do something else in the loop;
- `drive`: what the AV sees, and what a built-in one does;
- `judge`: how a test ends, and what is recorded of it;
- `loop`: a range of tests in a world, step by step.

They exchange arrays alone, all in one `cells.KernelState`; each function is called once a step for all K cells. They do
not know what an event is: a script says in which step it is, and from when on it can be seen.
"""
