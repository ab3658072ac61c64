-- Which run was the last, as the token of its lease, and how it ended; NULL while it goes on, and if it was killed.
ALTER TABLE job ADD COLUMN run     TEXT;
ALTER TABLE job ADD COLUMN outcome TEXT;
