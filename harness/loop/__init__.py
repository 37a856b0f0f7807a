"""The episode loop: what LV, BV and AV do in each step, who runs into whom, and what the test is worth.

It is written for one family of scenarios, a cut-in by BV while LV drives ahead of it, and knows it in these places:

- `cells`: what is remembered of a running episode, and the columns of its record;
- `path`: how the traffic moves before and after its decision, and who runs into it;
- `decide`: what is drawn in a step, and where an importance function is asked (`harness.families.cut_in.nade`);
- `drive`: what the AV sees and follows;
- `judge`: how an episode ends, and what stays of it;
- `likelihood_ratio`: the hazard of the one decision, in `forced_ratio` and `record_lane`; its mixtures hold for any;
- `harness.families.cut_in.laws`: initial states, accelerations, and the hazard; `harness.pool.aim` sums it.

They exchange arrays alone, all in one `cells.KernelState`: the world's positions and speeds (K cells, 3 vehicles),
`Cells` (the K running episodes), `Results` (rows of the shard), `PrescribedTraffic` (what LV and BV do, where a pool or
a baseline run says it), and the numbers and tables of `Environment` and `Importance`.

A second family (the vehicle ahead brakes, say) is a package beside this one that brings these files under the same
names. `loop` calls five of their functions, each for all cells at once (`decide`, `observe`, `command`, `judge`,
`fail`), and knows nothing else of them; runner, estimators and report know outcome, log weight, stratum and cell.
Beyond these files the cut-in has a name where a family would add its own: maneuvers and outcomes in
`harness.vocabulary`, columns in `harness.records.schemas`, what a controller sees in `harness.controllers.protocol`,
the change of lanes in `harness.worlds`, and the plots of where crashes lie in `harness.report.plots`.
"""
