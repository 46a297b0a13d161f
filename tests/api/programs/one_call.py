import fmu_mesh

result = fmu_mesh.simulate("fmus/DampedPendulum.fmu", stop_time=10.0, start_values={"a": 1.3})
result.plot("a")
print(result["a"][0], result.times[-1])
