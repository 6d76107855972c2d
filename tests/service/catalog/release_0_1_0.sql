-- A database as the last build of 0.1.0 with revisions 0001 to 0005 left it (sqlite3 .dump).
BEGIN TRANSACTION;
CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
INSERT INTO "alembic_version" VALUES('0005');
CREATE TABLE jobs (
	id VARCHAR NOT NULL, 
	kind VARCHAR NOT NULL, 
	map_id VARCHAR NOT NULL, 
	survey_id VARCHAR, 
	status VARCHAR NOT NULL, 
	message VARCHAR NOT NULL, 
	progress INTEGER NOT NULL, 
	problem JSON, 
	created DATETIME NOT NULL, 
	started DATETIME, 
	finished DATETIME, 
	updated DATETIME NOT NULL, attempts INTEGER DEFAULT '0' NOT NULL, model VARCHAR, 
	CONSTRAINT pk_jobs PRIMARY KEY (id), 
	CONSTRAINT fk_jobs_map_id FOREIGN KEY(map_id) REFERENCES maps (id) ON DELETE CASCADE, 
	CONSTRAINT fk_jobs_survey_id FOREIGN KEY(survey_id) REFERENCES surveys (id) ON DELETE CASCADE
);
INSERT INTO "jobs" VALUES('job-1','map','lobby',NULL,'successful','done',100,NULL,'2026-03-02 09:00:01.000000',NULL,'2026-03-02 09:00:02.000000','2026-03-02 09:00:02.000000',0,NULL);
INSERT INTO "jobs" VALUES('job-2','survey','lobby','survey-1','successful','done',100,NULL,'2026-03-02 09:00:03.000000',NULL,'2026-03-02 09:00:03.000000','2026-03-02 09:00:03.000000',0,NULL);
INSERT INTO "jobs" VALUES('job-3','map','lobby',NULL,'accepted','waiting',0,NULL,'2026-03-02 09:00:04.000000',NULL,NULL,'2026-03-02 09:00:04.000000',0,NULL);
INSERT INTO "jobs" VALUES('job-4','model','lobby',NULL,'successful','done',100,NULL,'2026-03-02 09:00:04.000000',NULL,'2026-03-02 09:00:05.000000','2026-03-02 09:00:05.000000',0,'lobby-net/1');
CREATE TABLE map_versions (
	job_id VARCHAR NOT NULL, 
	map_id VARCHAR NOT NULL, 
	number INTEGER NOT NULL, 
	status VARCHAR NOT NULL, 
	base_version INTEGER, 
	survey_id VARCHAR, 
	bounds JSON, 
	counts JSON NOT NULL, 
	registration JSON, 
	created DATETIME NOT NULL, 
	updated DATETIME NOT NULL, 
	CONSTRAINT pk_map_versions PRIMARY KEY (job_id), 
	CONSTRAINT fk_map_versions_map_id FOREIGN KEY(map_id) REFERENCES maps (id) ON DELETE CASCADE, 
	CONSTRAINT uq_map_versions_map_id_number UNIQUE (map_id, number)
);
INSERT INTO "map_versions" VALUES('job-1','lobby',1,'ready',NULL,NULL,'{"min": [0.0, 0.0, 0.0], "max": [3.0, 3.0, 1.0]}','{"tiles": 4}','{"scans": 1}','2026-03-02 09:00:01.000000','2026-03-02 09:00:02.000000');
INSERT INTO "map_versions" VALUES('job-3','lobby',2,'building',1,NULL,NULL,'{}',NULL,'2026-03-02 09:00:04.000000','2026-03-02 09:00:04.000000');
CREATE TABLE maps (
	id VARCHAR NOT NULL, 
	name VARCHAR, 
	model VARCHAR NOT NULL, 
	settings JSON NOT NULL, 
	created DATETIME NOT NULL, 
	updated DATETIME NOT NULL, anchor JSON, 
	CONSTRAINT pk_maps PRIMARY KEY (id)
);
INSERT INTO "maps" VALUES('lobby',NULL,'spicd-net/1','{}','2026-03-02 09:00:01.000000','2026-03-02 09:00:02.000000','{"longitude": 13.4, "latitude": 52.5, "height": 76.2, "heading": 90.0}');
CREATE TABLE models (
	job_id VARCHAR NOT NULL, 
	map_id VARCHAR NOT NULL, 
	map_version INTEGER NOT NULL, 
	name VARCHAR NOT NULL, 
	number INTEGER NOT NULL, 
	status VARCHAR NOT NULL, 
	base VARCHAR, 
	minutes DOUBLE NOT NULL, 
	epochs INTEGER, 
	card JSON, 
	created DATETIME NOT NULL, 
	updated DATETIME NOT NULL, 
	CONSTRAINT pk_models PRIMARY KEY (job_id), 
	CONSTRAINT fk_models_map_id FOREIGN KEY(map_id) REFERENCES maps (id) ON DELETE CASCADE, 
	CONSTRAINT uq_models_name_number UNIQUE (name, number)
);
INSERT INTO "models" VALUES('job-4','lobby',1,'lobby-net',1,'ready',NULL,5.0,NULL,'{"name": "lobby-net", "version": "1", "threshold": 0.4}','2026-03-02 09:00:04.000000','2026-03-02 09:00:05.000000');
CREATE TABLE scans (
	id VARCHAR NOT NULL, 
	filename VARCHAR NOT NULL, 
	format VARCHAR NOT NULL, 
	size BIGINT NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	device_id VARCHAR, 
	captured_at DATETIME, 
	pose JSON, 
	"key" VARCHAR NOT NULL, 
	created DATETIME NOT NULL, resent DATETIME, 
	CONSTRAINT pk_scans PRIMARY KEY (id)
);
INSERT INTO "scans" VALUES('scan-1','map-lobby.ply','ply',50,'map-lobby',NULL,NULL,NULL,'scans/scan-1-0/map-lobby.ply','2026-03-02 09:00:01.000000',NULL);
INSERT INTO "scans" VALUES('scan-2','visit-2026-03-01T12:00:00+00:00.ply','ply',72,'visit-2026-03-01T12:00:00+00:00',NULL,NULL,NULL,'scans/scan-2-0/visit-2026-03-01T12_00_00_00_00.ply','2026-03-02 09:00:03.000000',NULL);
INSERT INTO "scans" VALUES('scan-3','further-lobby-2.ply','ply',56,'further-lobby-2',NULL,NULL,NULL,'scans/scan-3-0/further-lobby-2.ply','2026-03-02 09:00:04.000000',NULL);
CREATE TABLE survey_scans (
	survey_id VARCHAR NOT NULL, 
	scan_id VARCHAR NOT NULL, 
	ordinal INTEGER NOT NULL, 
	accepted BOOLEAN, 
	fitness DOUBLE, 
	rmse DOUBLE, 
	map_from_scan JSON, 
	reason VARCHAR, translation_sigma DOUBLE, rotation_sigma DOUBLE, path JSON, 
	CONSTRAINT pk_survey_scans PRIMARY KEY (survey_id, scan_id), 
	CONSTRAINT fk_survey_scans_scan_id FOREIGN KEY(scan_id) REFERENCES scans (id), 
	CONSTRAINT fk_survey_scans_survey_id FOREIGN KEY(survey_id) REFERENCES surveys (id) ON DELETE CASCADE
);
INSERT INTO "survey_scans" VALUES('survey-1','scan-2',0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
CREATE TABLE survey_tiles (
	survey_id VARCHAR NOT NULL, 
	tile_id VARCHAR NOT NULL, 
	i INTEGER NOT NULL, 
	j INTEGER NOT NULL, 
	k INTEGER NOT NULL, 
	min_x DOUBLE NOT NULL, 
	min_y DOUBLE NOT NULL, 
	min_z DOUBLE NOT NULL, 
	max_x DOUBLE NOT NULL, 
	max_y DOUBLE NOT NULL, 
	max_z DOUBLE NOT NULL, 
	state VARCHAR NOT NULL, 
	score DOUBLE, 
	p_unchanged DOUBLE, 
	p_changed DOUBLE, 
	p_different DOUBLE, 
	n_reference INTEGER NOT NULL, 
	n_current INTEGER NOT NULL, 
	CONSTRAINT pk_survey_tiles PRIMARY KEY (survey_id, tile_id), 
	CONSTRAINT fk_survey_tiles_survey_id FOREIGN KEY(survey_id) REFERENCES surveys (id) ON DELETE CASCADE
);
INSERT INTO "survey_tiles" VALUES('survey-1','tile_000_000_000',0,0,0,0.0,0.0,0.0,1.5,1.5,1.0,'changed',0.9,0.09999999999999998,0.9,0.0,900,800);
INSERT INTO "survey_tiles" VALUES('survey-1','tile_001_000_000',1,0,0,1.5,0.0,0.0,3.0,1.5,1.0,'unobserved',NULL,NULL,NULL,NULL,900,3);
CREATE TABLE surveys (
	id VARCHAR NOT NULL, 
	map_id VARCHAR NOT NULL, 
	status VARCHAR NOT NULL, 
	model VARCHAR NOT NULL, 
	threshold DOUBLE, 
	device_id VARCHAR, 
	captured_at DATETIME NOT NULL, 
	counts JSON NOT NULL, 
	job_id VARCHAR NOT NULL, 
	created DATETIME NOT NULL, 
	updated DATETIME NOT NULL, map_version INTEGER DEFAULT '1' NOT NULL, 
	CONSTRAINT pk_surveys PRIMARY KEY (id), 
	CONSTRAINT fk_surveys_map_id FOREIGN KEY(map_id) REFERENCES maps (id) ON DELETE CASCADE
);
INSERT INTO "surveys" VALUES('survey-1','lobby','ready','spicd-net/1',0.5,NULL,'2026-03-01 12:00:00.000000','{"tiles": 2, "unchanged": 0, "changed": 1, "inconsistent": 0, "unobserved": 1}','job-2','2026-03-02 09:00:03.000000','2026-03-02 09:00:03.000000',1);
CREATE TABLE version_scans (
	job_id VARCHAR NOT NULL, 
	scan_id VARCHAR NOT NULL, 
	ordinal INTEGER NOT NULL, 
	accepted BOOLEAN, 
	fitness DOUBLE, 
	rmse DOUBLE, 
	map_from_scan JSON, 
	reason VARCHAR, 
	translation_sigma DOUBLE, 
	rotation_sigma DOUBLE, 
	path JSON, 
	CONSTRAINT pk_version_scans PRIMARY KEY (job_id, scan_id), 
	CONSTRAINT fk_version_scans_job_id FOREIGN KEY(job_id) REFERENCES map_versions (job_id) ON DELETE CASCADE, 
	CONSTRAINT fk_version_scans_scan_id FOREIGN KEY(scan_id) REFERENCES scans (id)
);
INSERT INTO "version_scans" VALUES('job-1','scan-1',0,1,0.98,0.02,'[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]',NULL,NULL,NULL,NULL);
INSERT INTO "version_scans" VALUES('job-3','scan-1',0,1,0.98,0.02,'[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]',NULL,NULL,NULL,NULL);
INSERT INTO "version_scans" VALUES('job-3','scan-3',1,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
CREATE INDEX ix_maps_created_id ON maps (created, id);
CREATE INDEX ix_scans_created_id ON scans (created, id);
CREATE INDEX ix_surveys_map_id_captured_at_id ON surveys (map_id, captured_at, id);
CREATE INDEX ix_surveys_map_id_created_id ON surveys (map_id, created, id);
CREATE INDEX ix_jobs_created_id ON jobs (created, id);
CREATE INDEX ix_jobs_map_id ON jobs (map_id);
CREATE INDEX ix_jobs_status ON jobs (status);
CREATE INDEX ix_jobs_survey_id ON jobs (survey_id);
CREATE INDEX ix_survey_scans_scan_id ON survey_scans (scan_id);
CREATE INDEX ix_survey_tiles_survey_id_state_score ON survey_tiles (survey_id, state, score);
CREATE INDEX ix_map_versions_map_id_created_job_id ON map_versions (map_id, created, job_id);
CREATE INDEX ix_version_scans_scan_id ON version_scans (scan_id);
CREATE INDEX ix_models_map_id ON models (map_id);
COMMIT;
