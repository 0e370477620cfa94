"""Imports an object from a USD file."""

from __future__ import annotations

from pathlib import Path

import vkc_pin as vkc

CHEST = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def Cube "case" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"])
{
    float3 xformOp:scale = (0.2, 0.3, 0.4)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}
def Xform "front" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
{
    double3 xformOp:translate = (-0.22, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Cube "board" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {
        float3 xformOp:scale = (0.01, 0.28, 0.15)
        uniform token[] xformOpOrder = ["xformOp:scale"]
    }
    def Capsule "handle" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {
        uniform token axis = "Y"
        double height = 0.2
        double radius = 0.01
        double3 xformOp:translate = (-0.07, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
def PhysicsPrismaticJoint "slide"
{
    rel physics:body0 = </case>
    rel physics:body1 = </front>
    uniform token physics:axis = "X"
    point3f physics:localPos0 = (-1.1, 0, 0)
    float physics:lowerLimit = -0.3
    float physics:upperLimit = 0
}
"""


def main() -> None:
    Path("chest.usda").write_text(CHEST, encoding="utf-8")
    chest = vkc.importing.import_object("chest.usda", "chest")
    assert chest.object.coordinates.names == ("slide",)
    assert chest.proposals.opening("slide")


if __name__ == "__main__":
    main()
