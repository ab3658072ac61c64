-- What computed an artifact, where that decides its last bits: a device of Cycles; '' if it does not, and before.
ALTER TABLE artifact ADD COLUMN device TEXT NOT NULL DEFAULT '';
CREATE INDEX artifact_by_device ON artifact (device, task) WHERE device != '';
