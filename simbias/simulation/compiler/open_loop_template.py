"""The text of a compiled open loop, with gaps that `simbias.simulation.open_loop` fills for a composition.

Arrays of all lanes have a row for each component: `x[i, lane]`. Pass b is world b // r on experiment b % r
of r experiments, which lie one after the other in states (F, n) and inputs (F, m). Their windows begin at
`firsts`, `leads` frames after the experiments.
"""

TEMPLATE = """\
def open_loop(
    window, chunk, nominal_parameters, bias_parameters, weights, offsets,
    firsts, leads, frames, first_chunks, states, inputs, begin, end, means,
):
    {rows}
    time, last, experiment = zeros({LANES}, int64), zeros({LANES}, int64), zeros({LANES}, int64)
    world, running = zeros({LANES}, int64), zeros({LANES}, int64)
    {constants}
    x[:] = nan  # in a lane without an experiment, so that no kernel works for nothing
    count, ended = 0, 1
    while True:
        if ended > 0:  # others take their places
            ended = 0
            for lane in range({LANES}):
                if running[lane] == 0 and begin < end:
                    world[lane], experiment[lane] = begin // firsts.shape[0], begin % firsts.shape[0]
                    begin += 1
                    count += 1
                    running[lane], last[lane] = 1, frames[experiment[lane]]
                    time[lane] = -leads[experiment[lane]]
                    weight[0, lane] = weights[world[lane]]
                    for i in range({nominal}):
                        nominal[i, lane] = nominal_parameters[world[lane], i]
                    for i in range({hidden}):
                        hidden[i, lane] = 0.0
                    for i in range({n}):
                        total[i, lane] = 0.0
            if count == 0:
                return
        for lane in range({LANES}):
            if running[lane] == 1:
                row = firsts[experiment[lane]] + time[lane]
                if time[lane] % window == 0 or time[lane] == -leads[experiment[lane]]:
                    for i in range({n}):
                        x[i, lane] = states[row, i] + offsets[world[lane], i]
                for i in range({m}):
                    u[i, lane] = inputs[row, i]
        {correct_all}
        for lane in range({LANES}):
            x_, u_ = {x}, {u}
            {advance}
            {settle}
        for lane in range({LANES}):
            if running[lane] == 1:
                time[lane] += 1
                if time[lane] % chunk == 0:
                    row = first_chunks[experiment[lane]] + time[lane] // chunk - 1
                    for i in range({n}):
                        if time[lane] > 0:
                            means[world[lane], row, i] = total[i, lane] / chunk
                        total[i, lane] = 0.0
                if time[lane] >= last[lane]:
                    running[lane] = 0
                    count -= 1
                    ended += 1
                    for i in range({n}):
                        x[i, lane] = nan
"""
