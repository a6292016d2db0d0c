"""Pictures that surfaces and skies are painted with: functions of a random generator, without Blender."""
