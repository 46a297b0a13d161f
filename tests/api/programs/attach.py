import fmu_mesh                                                   # 5 a mesh that somebody else started

with fmu_mesh.attach("pendulum_delay") as run:
    for sample in run.watch("delay.y"):                           # .value, .point, .time
        print(sample.value)
