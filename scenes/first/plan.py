"""Plans in the scene beside this file, and writes the motion as a web page."""

from pathlib import Path

import vkc_pin as vkc

folder = Path(__file__).parent
scene = vkc.load_scene(folder / "scene.yaml")
print(vkc.check_scene(scene))  # overlaps, and which handles the robot can reach

# What should change in the world: here the drawer is pulled out by 0.3 m. Other steps are Reach,
# Grasp, Touch, Place, Release and GoTo.
steps = [vkc.Actuate("drawer", {"slide": 0.3})]
plan = vkc.plan(scene, steps)
print(plan.summary())  # success, or the violated constraints by name

print("wrote", plan.to_html(folder / "plan.html"))  # open it in a browser
plan.save(folder / "plan.npz")  # vkc.Plan.load reads it; vkc-pin check validates it again
