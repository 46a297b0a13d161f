import fmu_mesh                                                   # 3 start, steer, wait

mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=60.0, real_time_factor=1.0)
mesh.add("gain", fmu="fmus/Gain.fmu")
with mesh.start() as run:                                         # left without wait(): the run is stopped
    run.set("gain.u", 3.0); run.set("gain.k", 2.5, at=1.5)
    run.pause(); print(run.get("gain.y"), run.status.point); run.step(10); run.resume()
    run.stop(); result = run.wait()
