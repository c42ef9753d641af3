from tests.stage.conftest import bank, bank_folder

__all__ = ["bank", "bank_folder"]
