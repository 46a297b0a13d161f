import fmu_mesh                                                   # 4 step by hand in this process: notebooks, optimizers, learning

with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
    while system.time < 1.0:
        system.step()
    state = system.save(); system.step(100); system.restore(state)
    print(system.time, system.get("pendulum.a"))
