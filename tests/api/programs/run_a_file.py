import fmu_mesh                                                   # 1 a file: run it, results as arrays

result = fmu_mesh.load("configs/pendulum_delay.yaml").run()       # processes; run(processes=False) is --local; window=, output=, on_progress= ...
print(result.times[-1], result["delay.y"].max(), result.units["pendulum.a"], result.summary)
result.to_pandas(); result.plot("pendulum.a", "delay.y").savefig("angles.png")
