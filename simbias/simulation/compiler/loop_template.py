"""The text of a compiled closed loop, whose gaps `simbias.simulation.compiler.fused` fills for a composition.

Arrays of all lanes have a row for each component: `x[i, lane]`. The arguments after the kernels' parameters
are noise (w (T+1), m+n), worlds (k,), starts (k, n), and what is filled: states (k, T+1, n) and inputs
(k, T, m), or neither; the cost's final_totals (k, s); frames (k,), and the criterion (k,) that each rollout
violated, -1 at the horizon.

It ends when so many rollouts as are `needed` have. Those under way then stay in the lanes, which are copied
to `carried`, if that has any rows; the next call, which begins with a copy of it, goes on with them. These
`begun` ones are its first.
"""

TEMPLATE = """\
def closed_loop(
    horizon, time_step, limits, measure_parameters, policy_constants, policy_parameters,
    nominal_parameters, bias_parameters, cost_parameters, noise, worlds, starts,
    states, inputs, final_totals, frames, violated, needed, begun, carried,
):
    {rows}
    {integers} = {rows_of_integers}
    limit = {limits}
    measure_data = {measure_data}
    policy_data = {policy_data}
    {constants}
    recorded = states.shape[0] > 0
    x[:] = nan  # in a lane without a rollout, so that no kernel works for nothing
    for row in range(carried.shape[0]):
        for lane in range({LANES}):
            lanes[row, lane] = carried[row, lane]
    ended = 1
    while True:
        if ended > 0:  # others take their places
            for lane in range({LANES}):
                if running[lane] == 0 and begun < starts.shape[0]:
                    b = begun
                    begun += 1
                    running[lane], frame[lane], rollout[lane] = 1, 0, b
                    first_row[lane] = worlds[b] * (horizon + 1)
                    for i in range({n}):
                        x[i, lane] = starts[b, i]
                    for i in range({policy}):
                        policy[i, lane] = policy_parameters[b, i]
                    for i in range({nominal}):
                        nominal[i, lane] = nominal_parameters[worlds[b], i]
                    for i in range({memory}):
                        memory[i, lane] = 0.0
{forget}                    for i in range({totals}):
                        totals[i, lane] = 0.0
            if needed <= 0:
                for row in range(carried.shape[0]):
                    for lane in range({LANES}):
                        carried[row, lane] = lanes[row, lane]
                return
        {gather}
        ended = 0
        for lane in range({LANES}):
            x_ = {x}
            measures = measure(x_, measure_data)
            failed = -1
            {judge}
            stop = (failed >= 0) | (frame[lane] >= horizon)
            {control}
            u_ = {force}
            {advance}
            {correct}
            ended += running[lane] if stop else 0
            criterion[lane] = failed
            stopping[lane] = 1 if stop else 0
            frame[lane] += 0 if stop else 1
        {correct_all}
        if recorded:
            for lane in range({LANES}):
                if running[lane] == 1 and stopping[lane] == 0:
                    b, t = rollout[lane], frame[lane]
                    for i in range({m}):
                        inputs[b, t - 1, i] = command[i, lane]
                    for i in range({n}):
                        states[b, t, i] = x[i, lane]
        if ended > 0:
            for lane in range({LANES}):
                if running[lane] == 1 and stopping[lane] == 1:
                    b = rollout[lane]
                    running[lane] = 0
                    needed -= 1
                    frames[b], violated[b] = frame[lane], criterion[lane]
                    for i in range({totals}):
                        final_totals[b, i] = before[i, lane]
                    for i in range({n}):
                        x[i, lane] = nan
"""

FORGET = """\
                    for i in range({hidden}):
                        hidden[i, lane] = 0.0
"""

CORRECT_ALL_LANES = """
        correct(x, force, bias_parameters, correction)
        for lane in range({LANES}):
            {settle}"""

GATHER = """
        for lane in range({LANES}):
            row = first_row[lane] + frame[lane]
            for i in range({m} + {n}):
                disturbance[i, lane] = noise[row, i]"""
